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
from support.faults.injected import wait_for

from mi_nerfattack.car.camera import v4l
from mi_nerfattack.car.camera.preparation import AsTheyCome
from mi_nerfattack.car.camera.v4l import V4lCamera
from mi_nerfattack.car.devices import DeviceLostError, Frame
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov

SMALL = AsTheyCome(from_fov(32, 16, 60))


def newest(camera: V4lCamera, index: int = 0) -> Frame:
    """Wait for a frame of at least this index, and return the newest."""
    wait_for(lambda: (frame := camera.newest()) and frame.index >= index)
    frame = camera.newest()
    assert frame is not None
    return frame


class Pipe:
    """A device that gives the raw video that a test writes into a named pipe."""

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
    level = int(np.mean(newest(camera, 99).image))
    monkeypatch.setattr(v4l, "_SILENT_S", 0.3)
    pipe.send(200)
    assert np.mean(newest(camera, 100).image) > level + 50
    started = time.monotonic()  # the device stalls from here on
    with pytest.raises(DeviceLostError, match="no image for 0.* is it plugged in"):
        while time.monotonic() < started + 60:
            assert camera.newest()
    pipe.send(3)  # and goes on
    wait_for(lambda: (frame := camera._unprepared) and frame[2] == 101)
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
    stand_in = Device()
    monkeypatch.setattr(v4l, "_opened", lambda *_, driver: stand_in)
    monkeypatch.setattr(v4l, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    yield stand_in
    stand_in.frames.put(None)


@pytest.mark.parametrize(
    ("ages_s", "times_s"),
    [
        ((0.25, 1.5, 100.0, -3.0), (4.75, 3.5, -95.0, 5.0)),  # however old
        ((-1.7e9, 1.0), (5.0, 5.0)),  # the first is of the future
        ((-0.001, 0.1), (5.0, 5.0)),
        ((100.0, 0.1), (5.0, 5.0)),  # or too old
        ((0.25, -0.001, 0.25), (4.75, 5.0, 5.0)),  # a later one is of the future
    ],
)
def test_times_of_another_clock_are_not_believed(device, ages_s, times_s):
    camera = V4lCamera("device", SMALL, clock=lambda: 5.0)
    for index, (age_s, time_s) in enumerate(zip(ages_s, times_s, strict=True)):
        device.send(1000.0 - age_s)
        assert newest(camera, index).time_s == pytest.approx(time_s)


def test_frames_that_nobody_asks_for_cost_nothing(device, monkeypatch):
    prepared = []

    def apply(image: np.ndarray) -> np.ndarray:
        prepared.append(image)
        return image

    monkeypatch.setattr(SMALL, "apply", apply)
    camera = V4lCamera("device", SMALL)
    for _ in range(50):
        device.send(999.9)
    wait_for(lambda: (frame := camera._unprepared) and frame[2] == 49)
    assert newest(camera, 49) is camera.newest()
    assert len(prepared) == 1
    camera.close()
    device.send(999.9)
    wait_for(lambda: not camera._thread.is_alive())  # and the device is let go
    camera.close()
    with pytest.raises(DeviceLostError, match="closed"):
        camera.newest()


@pytest.mark.parametrize(
    ("source", "driver", "message"),
    [
        ("color=red:s=64x32", "lavfi", "64 x 32 px; needs 32 x 16 px"),
        ("sine", "lavfi", "gives no pictures"),
        ("/dev/video0", "v4l9", "no driver 'v4l9'"),
    ],
)
def test_other_sizes_and_drivers_are_refused(source, driver, message):
    with pytest.raises(InputError, match=message):
        V4lCamera(source, SMALL, driver=driver)
