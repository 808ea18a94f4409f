"""A camera's reading thread, with FFmpeg's virtual camera and a pipe as devices."""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from av.video.frame import VideoFrame
from helpers.waiting import wait_for
from helpers.zed_files import calibration_text

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.robot.camera import v4l
from mi_nerfattack.robot.camera.preparation import AsTheyCome
from mi_nerfattack.robot.camera.v4l import V4lCamera
from mi_nerfattack.robot.camera.zed import LeftEye, read_left_eye
from mi_nerfattack.robot.devices import DeviceLostError, Frame

SMALL = AsTheyCome(from_fov(32, 16, 60))


def newest(camera: V4lCamera) -> Frame:
    """Wait for the first frame and return the newest."""
    wait_for(camera.newest)
    frame = camera.newest()
    assert frame is not None
    return frame


def test_the_left_half_of_a_live_device(tmp_path, monkeypatch):
    pytest.importorskip("cv2")
    monkeypatch.setattr(v4l, "_FIRST_S", 60.0)
    (tmp_path / "SN1.conf").write_text(calibration_text())
    eye = read_left_eye(tmp_path / "SN1.conf")
    prepare = LeftEye(eye, eye.camera())
    halves = [f"color={c}:s=672x376:r=50[{c}]" for c in ("red", "blue")]
    source = ";".join([*halves, "[red][blue]hstack,realtime"])
    before = time.monotonic()
    camera = V4lCamera(source, prepare, driver="lavfi")
    frame = newest(camera)
    assert frame.image.shape == (188, 336, 3)
    assert abs(frame.image.astype(int) - [254, 0, 0]).max() < 4
    assert before < frame.time_s <= time.monotonic()
    wait_for(lambda: newest(camera).index >= frame.index + 3)
    assert newest(camera).time_s > frame.time_s
    camera.close()
    camera.close()
    with pytest.raises(DeviceLostError, match="closed"):
        camera.newest()


class Pipe:
    """A device that gives what a test writes: raw video in a named pipe."""

    def __init__(self, path: str) -> None:
        self.path = path
        os.mkfifo(path)
        self.lead = threading.Thread(target=self._begin, daemon=True)
        self.lead.start()

    def _begin(self) -> None:
        self.file = open(self.path, "wb", buffering=0)  # noqa: SIM115
        self.file.write(b"YUV4MPEG2 W32 H16 F100:1 Ip A1:1 Cmono\n")
        for level in (0, 1, 2):
            self.send(level)

    def send(self, level: int) -> None:
        self.file.write(b"FRAME\n" + bytes([level]) * (32 * 16))


@pytest.fixture
def pipe(tmp_path):
    return Pipe(str(tmp_path / "device"))


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes")
def test_only_the_newest_is_kept_and_nothing_waits(pipe, monkeypatch):
    monkeypatch.setattr(v4l, "_FIRST_S", 60.0)
    camera = V4lCamera(pipe.path, SMALL, driver="yuv4mpegpipe")
    pipe.lead.join()
    for level in range(3, 100):
        pipe.send(level)
    wait_for(lambda: newest(camera).index == 99)
    level = int(np.mean(newest(camera).image))
    monkeypatch.setattr(v4l, "_SILENT_S", 0.3)
    pipe.send(200)
    wait_for(lambda: newest(camera).index == 100)
    assert np.mean(newest(camera).image) > level + 50
    started = time.monotonic()  # the device stalls from here on
    with pytest.raises(DeviceLostError, match="no image for 0.* is it plugged in"):
        while time.monotonic() < started + 60:
            assert camera.newest()
    pipe.send(3)  # and goes on
    wait_for(lambda: (kept := camera._unprepared) and kept[2] == 101)
    pipe.file.close()
    wait_for(lambda: camera._error)
    with pytest.raises(DeviceLostError, match="no more images"):
        camera.newest()


class Device:
    """A device of frames that a test makes, with the kernel's times."""

    def __init__(self) -> None:
        self.frames: queue.Queue[VideoFrame | None] = queue.Queue()

    def send(self, time_s: float) -> None:
        frame = VideoFrame.from_ndarray(np.zeros((16, 32, 3), np.uint8), "rgb24")
        base = Fraction(1, 1_000_000)
        frame.pts, frame.time_base = round(time_s / base), base
        self.frames.put(frame)

    def demux(self, video: int) -> Iterator[Any]:
        assert video == 0
        for frame in iter(self.frames.get, None):
            yield SimpleNamespace(decode=lambda frame=frame: [frame])

    def close(self) -> None:
        """Let go of nothing."""


@pytest.fixture
def device(monkeypatch):
    found = Device()
    monkeypatch.setattr(v4l, "_opened", lambda *_: found)
    monkeypatch.setattr(v4l, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    yield found
    found.frames.put(None)


def seen(camera: V4lCamera, index: int) -> Frame:
    """Wait for a frame and return it."""
    wait_for(lambda: (frame := camera.newest()) and frame.index == index)
    frame = camera.newest()
    assert frame is not None
    return frame


def test_the_kernels_times_are_kept_however_old(device):
    camera = V4lCamera("device", SMALL, clock=lambda: 5.0)
    for index, age_s in enumerate((0.25, 1.5, 100.0, -3.0)):
        device.send(1000.0 - age_s)
        assert seen(camera, index).time_s == pytest.approx(5.0 - max(0.0, age_s))


@pytest.mark.parametrize("times_s", [(1.7e9, 999.0), (1000.001, 999.9), (900.0, 999.9)])
def test_times_of_another_clock_are_not_believed(device, times_s):
    camera = V4lCamera("device", SMALL, clock=lambda: 5.0)
    for index, time_s in enumerate(times_s):
        device.send(time_s)
        assert seen(camera, index).time_s == 5.0


def test_times_that_run_ahead_are_not_believed_any_more(device):
    camera = V4lCamera("device", SMALL, clock=lambda: 5.0)
    for index, (age_s, time_s) in enumerate(((0.25, 4.75), (-0.001, 5.0), (0.25, 5.0))):
        device.send(1000.0 - age_s)
        assert seen(camera, index).time_s == pytest.approx(time_s)


def test_frames_that_nobody_asks_for_cost_nothing(device, monkeypatch):
    prepared = []

    def apply(image: np.ndarray) -> np.ndarray:
        prepared.append(image)
        return image

    monkeypatch.setattr(SMALL, "apply", apply)
    camera = V4lCamera("device", SMALL)
    for _ in range(50):
        device.send(999.9)
    wait_for(lambda: (kept := camera._unprepared) and kept[2] == 49)
    assert seen(camera, 49) is camera.newest()
    assert len(prepared) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="V4L is Linux's")
def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(
        InputError, match="/dev/video99: cannot be opened .* plug it in"
    ):
        V4lCamera("/dev/video99", SMALL)


def test_other_sizes_and_drivers_are_refused():
    with pytest.raises(InputError, match="64 x 32 px; needs 32 x 16 px"):
        V4lCamera("color=red:s=64x32", SMALL, driver="lavfi")
    with pytest.raises(InputError, match="gives no pictures"):
        V4lCamera("sine", SMALL, driver="lavfi")
    with pytest.raises(InputError, match="no driver 'v4l9'"):
        V4lCamera("/dev/video0", SMALL, driver="v4l9")
