"""A video that plays by a clock."""

from __future__ import annotations

import numpy as np
import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.video import write_video
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.robot.camera.preparation import AsTheyCome
from mi_nerfattack.robot.camera.video import VideoCamera
from mi_nerfattack.robot.devices import DeviceLostError

LEVELS = [20 + 20 * number for number in range(10)]


class HandClock:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.time_s = 50.0

    def __call__(self) -> float:
        return self.time_s


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "drive.mp4"
    frames = (np.full((16, 32, 3), level, np.uint8) for level in LEVELS)
    write_video(path, frames, 20)
    return path


def test_frames_come_at_their_times(video):
    clock = HandClock()
    camera = VideoCamera(video, AsTheyCome(from_fov(32, 16, 60)), clock)
    assert camera.camera.width == 32
    for time_s in (0.0, 0.049, 0.051, 0.2, 0.2, 0.499):
        clock.time_s = 50 + time_s
        frame = camera.newest()
        assert frame is not None and camera.newest() is frame
        index = int(time_s / 0.05 + 1e-9)
        assert frame.index == index
        assert frame.time_s == pytest.approx(50 + 0.05 * index)
        assert abs(frame.image.astype(float) - LEVELS[index]).max() < 3
    clock.time_s = 50.501
    with pytest.raises(DeviceLostError, match=r"drive.mp4: the video is over"):
        camera.newest()


def test_a_loop_goes_on(video):
    clock = HandClock()
    prepare = AsTheyCome(from_fov(32, 16, 60))
    camera = VideoCamera(video, prepare, clock, is_looped=True)
    for time_s in np.arange(0.025, 1.6, 0.05):
        clock.time_s = 50 + time_s
        frame, index = camera.newest(), int(time_s / 0.05)
        assert frame is not None and frame.index == index
        assert frame.time_s == pytest.approx(50 + 0.05 * index)
        assert abs(frame.image.astype(float) - LEVELS[index % 10]).max() < 3
    camera.close()
    with pytest.raises(DeviceLostError, match="closed"):
        camera.newest()


def test_other_sizes_and_files_are_refused(video, tmp_path):
    with pytest.raises(InputError, match="32 x 16 px; needs 64 x 32 px"):
        VideoCamera(video, AsTheyCome(from_fov(64, 32, 60)))
    (tmp_path / "none.mp4").write_bytes(b"not a video")
    with pytest.raises(InputError, match="none.mp4: damaged or truncated"):
        VideoCamera(tmp_path / "none.mp4", AsTheyCome(from_fov(64, 32, 60)))
    with pytest.raises(InputError, match="missing.mp4"):
        VideoCamera(tmp_path / "missing.mp4", AsTheyCome(from_fov(64, 32, 60)))
