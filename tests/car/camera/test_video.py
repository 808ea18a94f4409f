"""A ZED's left eye, a video that plays by a clock, and words that name cameras."""

from __future__ import annotations

import numpy as np
import pytest
from support.files.recordings import DISTORTION, both_eyes, calibration_text, pattern

from mi_nerfattack.car.camera import open as opening
from mi_nerfattack.car.camera.open import ZedOptions, open_camera
from mi_nerfattack.car.camera.preparation import AsTheyCome
from mi_nerfattack.car.camera.video import VideoCamera
from mi_nerfattack.car.camera.zed import EyeCalibration, LeftEye, read_left_eye
from mi_nerfattack.car.devices import DeviceLostError
from mi_nerfattack.errors import InputError
from mi_nerfattack.io.video import write_video
from mi_nerfattack.render.camera.distortion import undistort
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov

pytest.importorskip("cv2")
WIDE = from_fov(200, 66, 110.0)


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


RATIONAL = (*DISTORTION[:4], 0.004, 0.01, -0.002, 0.0003)


@pytest.mark.parametrize("lens", [DISTORTION, RATIONAL])
def test_a_lens_in_a_section_of_its_own(conf, lens):
    conf.write_text(calibration_text(lens, is_apart=True) + "[LEFT_DISTO2]\n")
    eye = read_left_eye(conf)
    assert eye.distortion == lens
    assert error_of(eye, eye.camera(), lens).max() < 2.5


CUBIC = (*DISTORTION[:4], -0.004)


def test_a_third_radial_term_is_only_taken_out(conf):
    conf.write_text(calibration_text(CUBIC))
    eye = read_left_eye(conf)
    assert error_of(eye, eye.camera(), CUBIC).max() < 2.5


PLAIN, APART = calibration_text(), calibration_text(RATIONAL, is_apart=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PLAIN.replace("fx = 351.2", "fx = -3"), "fx: -3.0; must be positive"),
        (PLAIN.replace("fx = 351.2", "fx = wide"), "fx: 'wide'; must be a finite num"),
        (PLAIN.replace("fx = 351.2\n", ""), "fx: None"),
        (PLAIN.replace("cx = 330.4", "cx = 900"), "cx 900, cy 185.3 lie outside 672 x"),
        (PLAIN.replace("k1 = -0.1712", "k1 = nan"), "k1: 'nan'"),
        (PLAIN.replace("k1 = -0.1712\n", ""), "k1: None"),
        (PLAIN.replace("k1 = ", "k7 = "), r"VGA\]: k7: no coefficient"),
        (PLAIN.replace("[LEFT_CAM_VGA]", "LEFT"), "no calibration file of a ZED"),
        (PLAIN + "[LEFT_DISTO]\nk1 = 0.1\nk2 = 0\n", "2 of them"),
        (APART.replace("[LEFT_DISTO]", "[LEFT_LENS]"), "LEFT_DISTO.*: 0 of them"),
        (APART.replace("k6 = ", "s1 = 0.1\nk6 = "), r"\[LEFT_DISTO\]: s1: no coeff"),
    ],
)
def test_files_that_are_refused(conf, text, message):
    conf.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_left_eye(conf)
    assert caught.value.where == str(conf)


def test_a_size_that_the_file_has_not_is_refused(conf):
    with pytest.raises(InputError, match=r"\[LEFT_CAM_2K\] is missing"):
        read_left_eye(conf, "HD2K")
    with pytest.raises(InputError, match="'4K'; one of HD2K, HD1080, "):
        read_left_eye(conf, "4K")


FOLDED = (0.0, 0.0, 0.0, 0.0, 0.0, -2.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("lens", "make", "message"),
    [
        (DISTORTION, lambda eye: LeftEye(eye, WIDE), "sees .* px beyond the eye's pic"),
        (
            (0.3, 0.0, 0.0, 0.0, 0.0),
            lambda eye: LeftEye(eye, eye.camera()),
            "px beyond",
        ),
        ((-0.3, 0.0, 0.0, 0.0, 0.0), lambda eye: LeftEye(eye, WIDE), "folds the image"),
        ((-2.0, 0.0, 0.0, 0.0, 0.0), lambda eye: LeftEye(eye, eye.camera()), "folds"),
        ((-2.0, 0.0, 0.0, 0.0, 0.0), lambda eye: eye.camera(None, False), "folds"),
        (FOLDED, lambda eye: LeftEye(eye, eye.camera()), "folds"),
        (CUBIC, lambda eye: eye.camera(None, False), "k3 is -0.004.* take the disto"),
        (DISTORTION, lambda eye: eye.camera((700, 376)), "700 x 376 px; from 1 x 1 to"),
    ],
)
def test_pictures_that_no_lens_gives_are_refused(conf, lens, make, message):
    conf.write_text(calibration_text(lens, is_apart=lens is FOLDED))
    with pytest.raises(InputError, match=message):
        make(read_left_eye(conf))


SMALL = AsTheyCome(from_fov(32, 16, 60))
LEVELS = [20 + 20 * number for number in range(10)]


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "drive.mp4"
    frames = (np.full((16, 32, 3), level, np.uint8) for level in LEVELS)
    write_video(path, frames, 20)
    return path


@pytest.mark.parametrize("is_looped", [False, True])
def test_frames_come_at_their_times(video, is_looped):
    now = [50.0]
    camera = VideoCamera(video, SMALL, lambda: now[0], is_looped=is_looped)
    assert camera.camera.width == 32
    edges = [0.0, 0.049, 0.051, 0.2, 0.2, 0.499]
    for time_s in np.arange(0.025, 1.6, 0.05) if is_looped else edges:
        now[0] = 50 + time_s
        frame, index = camera.newest(), int(time_s / 0.05 + 1e-9)
        assert frame is not None and camera.newest() is frame
        assert frame.index == index
        assert frame.time_s == pytest.approx(50 + 0.05 * index)
        assert abs(frame.image.astype(float) - LEVELS[index % 10]).max() < 3
    now[0] = 50.501
    if is_looped:
        camera.close()
    end = "closed" if is_looped else "drive.mp4: the video is over"
    with pytest.raises(DeviceLostError, match=end):
        camera.newest()


def test_words_name_cameras(video, tmp_path, monkeypatch):
    asked = from_fov(32, 16, 60)
    assert open_camera(f"video:{video}", asked).newest() is not None
    (tmp_path / "none.mp4").write_bytes(b"not a video")
    monkeypatch.setattr(opening, "SETTINGS", tmp_path)
    wrong = ("", "zed", "v4l:", "webcam:0", "/dev/video0")
    for words, camera, message in (
        *((word, asked, "must be zed:/dev/videoN, v4l:/dev/videoN") for word in wrong),
        (f"video:{video}", None, "no intrinsics"),
        (f"video:{video}", from_fov(64, 32, 60), "32 x 16 px; needs 64 x 32 px"),
        (f"video:{tmp_path / 'none.mp4'}", asked, "none.mp4: damaged or truncated"),
        (f"video:{tmp_path / 'missing.mp4'}", asked, "missing.mp4"),
        ("v4l:/dev/video99", asked, "/dev/video99: .*plug it in"),
        ("zed:/dev/video99", None, "no calibration named; .* has none"),
    ):
        with pytest.raises(InputError, match=message):
            open_camera(words, camera)
    for name in ("SN1.conf", "SN2.conf"):
        (tmp_path / name).write_text(calibration_text())
    with pytest.raises(InputError, match="SN1.conf, SN2.conf: name the file"):
        open_camera("zed:/dev/video99")


def test_a_video_of_both_eyes_gives_the_left_one(tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "SETTINGS", tmp_path)
    (tmp_path / "SN1.conf").write_text(calibration_text())
    write_video(tmp_path / "both.mp4", [both_eyes()] * 2, 10)
    words = f"video:{tmp_path / 'both.mp4'}"
    camera = open_camera(words, zed=ZedOptions())
    frame = camera.newest()
    assert frame is not None and frame.image.shape == (188, 336, 3)
    # the right eye's frame is white
    expected = ZedOptions(tmp_path / "SN1.conf").build().apply(both_eyes())
    assert abs(frame.image.astype(int) - expected).mean() < 4
    camera.close()
    # into the camera that a policy knows
    asked = from_fov(100, 40, 80.0)
    camera = open_camera(words, asked, ZedOptions())
    frame = camera.newest()
    assert camera.camera is asked
    assert frame is not None and frame.image.shape == (40, 100, 3)
    camera.close()
