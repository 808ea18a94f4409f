"""A ZED's left eye: its file, and where its pixels look."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.zed_files import DISTORTION, both_eyes, calibration_text, pattern

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.distortion import undistort
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov
from mi_nerfattack.robot.camera.zed import EyeCalibration, LeftEye, read_left_eye

pytest.importorskip("cv2")


@pytest.fixture
def conf(tmp_path):
    path = tmp_path / "SN12345678.conf"
    path.write_text(calibration_text())
    return path


def test_the_file_is_read(conf):
    eye = read_left_eye(conf)
    assert eye.pinhole == Camera(672, 376, 351.2, 349.6, 330.9, 185.8)
    assert eye.distortion == DISTORTION
    assert read_left_eye(conf, "HD720").pinhole.width == 1280
    with pytest.raises(InputError, match=r"\[LEFT_CAM_2K\] is missing"):
        read_left_eye(conf, "HD2K")
    with pytest.raises(InputError, match="'4K'; one of HD2K, HD1080, HD720, VGA"):
        read_left_eye(conf, "4K")


def error_of(eye: EyeCalibration, camera: Camera, distortion=DISTORTION) -> np.ndarray:
    """Return how far each pixel is from what lies in its direction, levels."""
    prepare = LeftEye(eye, camera)
    image = prepare.apply(both_eyes(distortion))
    assert prepare.camera is camera and image.dtype == np.uint8
    assert image.shape == (camera.height, camera.width, 3)
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    x, y = np.meshgrid(
        (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    )
    if camera.is_distorted:
        x, y = undistort(x, y, *camera.distortion)
    return abs(image - pattern(x, y))[2:-2, 2:-2]


@pytest.mark.parametrize("size", [None, (672, 376), (366, 188)])
@pytest.mark.parametrize("is_undistorted", [True, False])
def test_pixels_look_where_the_eyes_camera_says(conf, size, is_undistorted):
    eye = read_left_eye(conf)
    camera = eye.camera(size, is_undistorted)
    assert (camera.width, camera.height) == (size or (336, 188))
    assert camera.is_distorted != is_undistorted
    error = error_of(eye, camera)
    # a tenth of a pixel of half size is 1.4 levels; rounding makes up to 1.5
    assert error.mean() < 0.7 and error.max() < 2.5


@pytest.mark.parametrize(
    "camera",
    [
        Camera(336, 188, 172.0, 168.0, 168.0, 94.0),
        Camera(200, 66, 100.0, 100.0, 97.0, 35.0, k1=0.05, p1=1e-3),
        from_fov(640, 200, 60.0),  # finer than the eye
    ],
)
def test_a_zed_shows_what_another_camera_would(conf, camera):
    error = error_of(read_left_eye(conf), camera)
    assert error.mean() < 0.8 and error.max() < 4


def test_a_camera_that_sees_more_is_refused(conf):
    wide = from_fov(200, 66, 110.0)
    with pytest.raises(InputError, match="sees .* px beyond the eye's picture of"):
        LeftEye(read_left_eye(conf), wide)
    conf.write_text(calibration_text((-0.3, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="folds the image over itself where the"):
        LeftEye(read_left_eye(conf), wide)


def test_a_third_radial_term_is_only_taken_out(tmp_path):
    distortion = (*DISTORTION[:4], -0.004)
    (tmp_path / "SN1.conf").write_text(calibration_text(distortion))
    eye = read_left_eye(tmp_path / "SN1.conf")
    assert error_of(eye, eye.camera(), distortion).max() < 2.5
    with pytest.raises(InputError, match="k3 is -0.004.* take the distortion out"):
        eye.camera(is_undistorted=False)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fx = 351.2", "fx = -3", "fx: -3.0; must be positive"),
        ("fx = 351.2", "fx = wide", "fx: 'wide'; must be a finite number"),
        ("fx = 351.2\n", "", "fx: None"),
        ("cx = 330.4", "cx = 900", "cx 900, cy 185.3 lie outside 672 x 376"),
        ("k1 = -0.1712", "k1 = nan", "k1: 'nan'"),
        ("[LEFT_CAM_VGA]", "LEFT", "no calibration file of a ZED"),
    ],
)
def test_damaged_files_are_refused(conf, old, new, message):
    conf.write_text(calibration_text().replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        read_left_eye(conf)
    assert str(conf) in str(caught.value)


def test_impossible_pictures_are_refused(conf):
    eye = read_left_eye(conf)
    with pytest.raises(InputError, match="700 x 376 px; from 1 x 1 to 672 x 376"):
        eye.camera((700, 376))
    conf.write_text(calibration_text((0.3, 0.0, 0.0, 0.0, 0.0)))
    eye = read_left_eye(conf)
    with pytest.raises(InputError, match="px beyond the eye's picture"):
        LeftEye(eye, eye.camera())
    conf.write_text(calibration_text((-2.0, 0.0, 0.0, 0.0, 0.0)))
    eye = read_left_eye(conf)
    with pytest.raises(InputError, match="SN12345678.conf.*folds"):
        eye.camera(is_undistorted=False)
    with pytest.raises(InputError, match="SN12345678.conf.*folds"):
        LeftEye(eye, eye.camera())
