"""Words that name cameras."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.zed_files import both_eyes, calibration_text

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.video import write_video
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.robot.camera import open as opening
from mi_nerfattack.robot.camera.open import ZedOptions, open_camera


def test_a_video_of_both_eyes_gives_the_left_one(tmp_path, monkeypatch):
    pytest.importorskip("cv2")
    monkeypatch.setattr(opening, "SETTINGS", tmp_path)
    with pytest.raises(InputError, match="no calibration named; .* has none"):
        open_camera("zed:/dev/video99")
    (tmp_path / "SN1.conf").write_text(calibration_text())
    write_video(tmp_path / "both.mp4", [both_eyes()] * 2, 10)
    camera = open_camera(f"video:{tmp_path / 'both.mp4'}", zed=ZedOptions())
    frame = camera.newest()
    assert frame is not None and frame.image.shape == (188, 336, 3)
    # the right eye's frame is white
    expected = ZedOptions(tmp_path / "SN1.conf").build().apply(both_eyes())
    assert abs(frame.image.astype(int) - expected).mean() < 4
    camera.close()
    # into the camera that a policy knows
    asked = from_fov(100, 40, 80.0)
    camera = open_camera(f"video:{tmp_path / 'both.mp4'}", asked, ZedOptions())
    frame = camera.newest()
    assert camera.camera is asked
    assert frame is not None and frame.image.shape == (40, 100, 3)
    camera.close()
    (tmp_path / "SN2.conf").write_text(calibration_text())
    with pytest.raises(InputError, match="SN1.conf, SN2.conf: name the file"):
        open_camera("zed:/dev/video99")


def test_a_video_is_opened(tmp_path):
    write_video(tmp_path / "a.mp4", [np.zeros((16, 32, 3), np.uint8)] * 2, 10)
    text, camera = f"video:{tmp_path / 'a.mp4'}", from_fov(32, 16, 60)
    assert open_camera(text, camera).newest() is not None
    with pytest.raises(InputError, match="no intrinsics"):
        open_camera(text)


@pytest.mark.parametrize("text", ["", "zed", "v4l:", "webcam:0", "/dev/video0"])
def test_other_words_are_refused(text):
    with pytest.raises(InputError, match="must be zed:/dev/videoN, v4l:/dev/videoN"):
        open_camera(text, from_fov(32, 16, 60))


def test_a_device_that_is_not_there_is_told():
    with pytest.raises(InputError, match="/dev/video99"):
        open_camera("v4l:/dev/video99", from_fov(32, 16, 60))
