"""The process around the `motioncapture` package, with a stand-in for the package."""

from __future__ import annotations

import os
import re
import signal
import sys
import time

import numpy as np
import pytest
from support.faults.injected import wait_for

from mi_nerfattack.car.devices import DeviceLostError
from mi_nerfattack.car.tracker.motion_capture import MotionCaptureTracker
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import install_hint

STAND_IN = """
import ctypes, os, time
from types import SimpleNamespace as Of


def connect(kind, options):
    host = options["hostname"]
    if host == "never":
        while True:
            time.sleep(1)
    if host == "holding":  # as the real client, which keeps the interpreter
        ctypes.PyDLL(None).sleep(1000)
    if host == "dying":
        os._exit(3)
    if kind != "vicon":
        raise RuntimeError("Unknown motion capture type!")
    return System(host)


class System:
    def __init__(self, host):
        self.host, self.count, self.rigidBodies = host, 0, {}

    def waitForNextFrame(self):
        self.count += 1
        if self.count > 3 and self.host == "silent":
            time.sleep(1000)
        if self.count > 3 and self.host == "failing":
            raise RuntimeError("stream ended")
        time.sleep(0.005)
        seen, nan = Of(x=0.0, y=0.0, z=2 ** -0.5, w=2 ** -0.5), float("nan")
        self.rigidBodies = {
            "car": Of(position=(1.0, 2.0, self.count / 8), rotation=seen),
            "hidden": Of(position=(nan,) * 3, rotation=Of(x=nan, y=nan, z=nan, w=nan)),
            "turnless": Of(position=(1.0, 2.0, 3.0), rotation=Of(x=0, y=0, z=0, w=0)),
            "still": Of(position=(1.0, 2.0, 3.0), rotation=seen),
        }
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    (tmp_path / "motioncapture.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("motioncapture", None)


def test_poses_come_with_their_times(stand_in):
    tracker = MotionCaptureTracker("vicon", "live")
    wait_for(lambda: (pose := tracker.newest("car")) and pose.index >= 20)
    first = tracker.newest("car")
    wait_for(lambda: tracker.newest("car").index > first.index)
    second = tracker.newest("car")
    height = (second.index + 1) / 8
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, height], [0, 0, 0, 1]]
    assert second.body_to_world == pytest.approx(np.array(expected), abs=1e-12)
    assert first.time_s < second.time_s <= time.monotonic()
    assert tracker.newest("hidden") is None and tracker.newest("turnless") is None
    assert "car, still, not 'hidden'" in tracker.explain("hidden")
    assert "bit for bit" in tracker.explain("still")
    assert tracker.newest("still").index == 3
    os.kill(tracker._process.pid, signal.SIGKILL)
    wait_for(lambda: tracker._error)
    with pytest.raises(DeviceLostError, match="vicon at live: its process ended"):
        tracker.newest("car")
    tracker.close()
    tracker.close()


@pytest.mark.parametrize(
    ("kind", "host", "message"),
    [
        ("vicon", "never", "never: no answer within 0.2 s .* is its server on"),
        ("vicon", "holding", "holding: no answer within 0.2 s"),
        ("vicon", "dying", "exit code 3"),
        ("nonsense", "live", "Unknown motion capture type"),
    ],
)
def test_a_server_that_does_not_answer_is_told(stand_in, kind, host, message):
    with pytest.raises(InputError, match=message):
        MotionCaptureTracker(kind, host, timeout_s=0.2)


def test_a_stream_that_fails_or_falls_silent(stand_in):
    for host, clock, message in (
        ("failing", time.monotonic, "stream ended"),
        ("live", lambda: 1 / 0, "live: reading failed .ZeroDivision"),
    ):
        failing = MotionCaptureTracker("vicon", host, clock=clock)
        wait_for(lambda failing=failing: failing._error)
        with pytest.raises(DeviceLostError, match=message):
            failing.newest("car")
        failing.close()
    silent = MotionCaptureTracker("vicon", "silent")
    wait_for(lambda: (pose := silent.newest("car")) and pose.index == 2)
    silent.close()  # though its process hears nothing
    with pytest.raises(DeviceLostError, match="closed"):
        silent.newest("car")


def test_the_package_itself():
    pytest.importorskip("motioncapture")
    tracker = MotionCaptureTracker("mock", "")
    wait_for(lambda: tracker._frame >= 0)
    assert tracker.newest("car") is None
    assert "no body, not 'car'" in tracker.explain("car")
    tracker.close()


def test_a_missing_package_and_no_time_are_refused(stand_in, monkeypatch):
    with pytest.raises(InputError, match="timeout_s: 0"):
        MotionCaptureTracker("vicon", "live", timeout_s=0)
    monkeypatch.setitem(sys.modules, "motioncapture", None)
    with pytest.raises(SetupError, match=re.escape(install_hint("motion-capture"))):
        MotionCaptureTracker("vicon", "live")
