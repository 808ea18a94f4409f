"""A ZED's left eye: its file, and where its pixels look."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.zed_files import DISTORTION, both_eyes, calibration_text, pattern

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.distortion import undistort
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.robot.camera.zed import LeftEye, read_left_eye

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


@pytest.mark.parametrize("size", [None, (672, 376), (366, 188)])
@pytest.mark.parametrize("is_undistorted", [True, False])
def test_pixels_look_where_the_camera_says(conf, size, is_undistorted):
    prepare = LeftEye(read_left_eye(conf), size, is_undistorted)
    camera, image = prepare.camera, prepare.apply(both_eyes())
    assert (camera.width, camera.height) == (size or (336, 188))
    assert image.shape == (camera.height, camera.width, 3) and image.dtype == np.uint8
    assert camera.is_distorted != is_undistorted
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    x, y = np.meshgrid(
        (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    )
    if not is_undistorted:
        x, y = undistort(x, y, *camera.distortion)
    error = abs(image - pattern(x, y))[2:-2, 2:-2]
    # a tenth of a pixel of half size is 1.4 levels; rounding makes up to 1.5
    assert error.mean() < 0.7 and error.max() < 2.5


def test_a_third_radial_term_is_only_taken_out(tmp_path):
    distortion = (*DISTORTION[:4], -0.004)
    (tmp_path / "SN1.conf").write_text(calibration_text(distortion))
    eye = read_left_eye(tmp_path / "SN1.conf")
    prepare = LeftEye(eye)
    camera, image = prepare.camera, prepare.apply(both_eyes(distortion))
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    error = abs(image - pattern(*np.meshgrid(x, y)))[2:-2, 2:-2]
    assert error.max() < 2.5
    with pytest.raises(InputError, match="k3 is -0.004.* take the distortion out"):
        LeftEye(eye, is_undistorted=False)


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
        LeftEye(eye, (700, 376))
    conf.write_text(calibration_text((0.3, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="leaves parts of the image empty"):
        LeftEye(read_left_eye(conf))
    conf.write_text(calibration_text((-2.0, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="SN12345678.conf.*folds"):
        LeftEye(read_left_eye(conf), is_undistorted=False)
