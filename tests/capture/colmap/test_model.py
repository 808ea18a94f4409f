"""COLMAP models against files written by hand."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.faults.refusals import refusals

from mi_nerfattack.capture.colmap.model import find_model
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera

pytest.importorskip("pycolmap")
pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 40, 30
OPENCV = (42.0, 43.0, 20.5, 14.25, 0.02, -0.004, 0.001, -0.002)
PINHOLE = (50.0, 51.0, 20.0, 15.0)
# a quarter turn about y: the camera looks along -x of the world, world to camera
POSES = {
    "b.png": ((0.5**0.5, 0.0, 0.5**0.5, 0.0), (0.3, -0.2, 4.0), 1),
    "a.png": ((0.7, 0.1, -0.7, 0.1), (0.1, 0.2, 3.0), 7),
}
POINTS = ((0.0, 0.1, 0.2), (1.0, -1.0, 0.5), (-0.25, 0.5, 2.0))


def write_text_model(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)

    def join(values) -> str:
        return " ".join(map(repr, values))

    (folder / "cameras.txt").write_text(
        "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 OPENCV {WIDTH} {HEIGHT} {join(OPENCV)}\n"
        f"7 PINHOLE {WIDTH} {HEIGHT} {join(PINHOLE)}\n"
    )
    lines = ["# Image list with two lines of data per image:"]
    for i, (name, (q, t, camera)) in enumerate(POSES.items()):
        lines += [f"{i + 1} {join(q)} {join(t)} {camera} {name}"]
        lines += ["1.5 2.5 0 7.0 8.0 1 9.0 3.0 2" if i else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text(
        "".join(f"{i} {join(p)} 1 2 3 0.5 2 {i}\n" for i, p in enumerate(POINTS))
    )
    return folder


def write_binary_model(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    cameras = struct.pack("<Q", 2)
    cameras += struct.pack("<iiQQ8d", 1, 4, WIDTH, HEIGHT, *OPENCV)
    cameras += struct.pack("<iiQQ4d", 7, 1, WIDTH, HEIGHT, *PINHOLE)
    (folder / "cameras.bin").write_bytes(cameras)
    images = struct.pack("<Q", len(POSES))
    for i, (name, (q, t, camera)) in enumerate(POSES.items()):
        images += struct.pack("<I7dI", i + 1, *q, *t, camera)
        images += name.encode() + b"\0" + struct.pack("<Q", 3 * i)
        for feature in range(3 * i):
            images += struct.pack("<ddq", 1.5, 2.5, feature)
    (folder / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(POINTS))
    for i, point in enumerate(POINTS):
        points += struct.pack("<Q3d3Bd", i, *point, 1, 2, 3, 0.5)
        points += struct.pack("<QII", 1, 2, i)
    (folder / "points3D.bin").write_bytes(points)
    return folder


def write_photographs(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(3)
    for name in POSES:
        image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        files.write_image(folder / name, image)


@pytest.fixture
def scene(tmp_path):
    """A folder with a model in sparse/0 and its images."""
    write_photographs(tmp_path / "images")
    write_text_model(tmp_path / "sparse" / "0")
    return tmp_path


def colmap_projection(q, t, point, parameters):
    """COLMAP's documented formulas, written out: rotate, divide, distort, scale."""
    a, b, c = Rotation.from_quat(q, scalar_first=True).apply(point) + t
    u, v = a / c, b / c
    fx, fy, cx, cy, k1, k2, p1, p2 = (*parameters, 0, 0, 0, 0)[:8]
    r2 = u * u + v * v
    radial = k1 * r2 + k2 * r2 * r2
    du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    return fx * (u + du) + cx, fy * (v + dv) + cy


def our_pixel(camera: Camera, camera_to_world, point):
    cv2 = pytest.importorskip("cv2")
    to_camera = np.linalg.inv(camera_to_world)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    turn = cv2.Rodrigues(to_camera[:3, :3])[0]
    lens = np.array(camera.distortion)
    point = np.array([point], float)
    return cv2.projectPoints(point, turn, to_camera[:3, 3], matrix, lens)[0].ravel()


@pytest.mark.parametrize("write", [write_text_model, write_binary_model])
def test_everything_is_as_written(tmp_path, write):
    write_photographs(tmp_path / "images")
    write(tmp_path / "sparse" / "0")
    posed = read_images(tmp_path)
    assert posed.names == ("a.png", "b.png")  # by name, not by number
    lenses = OPENCV, PINHOLE
    for name, camera, pose in zip(
        posed.names, posed.cameras, posed.camera_to_world, strict=True
    ):
        q, t, camera_id = POSES[name]
        for point in POINTS:
            arguments = q, t, np.array(point), lenses[camera_id == 7]
            pixel = our_pixel(camera, pose, point)
            np.testing.assert_allclose(pixel, colmap_projection(*arguments), atol=1e-6)
    # R maps world (x, y, z) to camera (z, y, -x); so the eye is -R^T t
    np.testing.assert_allclose(posed.camera_to_world[1, :3, 3], [4.0, 0.2, -0.3])
    np.testing.assert_allclose(posed.camera_to_world[1, :3, 2], [-1, 0, 0], atol=1e-12)
    first = files.read_image(tmp_path / "images" / "a.png")
    np.testing.assert_array_equal(posed.images[0], first)
    np.testing.assert_array_equal(posed.points, POINTS)
    assert posed.unit == "arbitrary"
    assert posed.cameras == tuple(Camera(WIDTH, HEIGHT, *lens) for lens in lenses[::-1])


@pytest.mark.parametrize(
    ("model", "images"),
    [
        (".", "images"),
        ("sparse", "."),
        ("sparse/0", "sparse/0"),
        ("colmap/sparse/0", "colmap/images"),
    ],
)
def test_places(tmp_path, model, images):
    write_text_model(tmp_path / model)
    write_photographs(tmp_path / images)
    assert find_model(tmp_path) == tmp_path / model
    assert len(read_images(tmp_path)) == 2


def test_images_that_are_missing_or_of_another_size(scene):
    (scene / "sparse/0/points3D.txt").unlink()
    assert read_images(scene).points is None
    files.write_image(scene / "images/b.png", np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"b.png: 4 x 3 px.*cameras.*40 x 30"):
        read_images(scene)
    (scene / "images/b.png").unlink()
    with pytest.raises(InputError, match="images.*: 1 of 2 .*'b.png'.*--skip-missing"):
        read_images(scene)
    posed = read_images(scene, skip_missing=True)
    assert posed.names == ("a.png",) and posed.missing == ("b.png",)
    assert posed.cameras == () and posed.camera == Camera(WIDTH, HEIGHT, *PINHOLE)
    (scene / "images/a.png").unlink()
    with pytest.raises(InputError, match="none of the 2 images.*'a.png'.*looked in"):
        read_images(scene, skip_missing=True)


test_nothing_there = refusals(
    (lambda at: read_images(at / "p"), "p: does not exist"),
    (read_images, "no posed images; looked for .*sparse/0"),
)


LINES = [
    ("cameras", "3 PINHOLE 40 30 -1 1 1 1", "camera 3: camera.fx: -1"),
    ("cameras", "3 FOV 40 30 1 1 1 1 1", "camera 3: model FOV; .*PINHOLE"),
    ("images", "1 0 0 0 0 0 0 0 1 a.png\n\n", "image 'a.png': quaternion"),
    ("images", "1 1 0 0 0 0 0 0 1 a\x07.png", "image .*: unprintable"),
    ("images", "1 1 0 0 0 0 0 0 1 a b.png", ".*11 words"),
    ("images", "# none", "the model holds no image"),
    ("images", "1 1 0 0 0 0 0 0 1 a\n\n2 1 0 0 0 0 0 0 1 a\n\n", "image 'a' occurs 2"),
]


@pytest.mark.parametrize(("name", "text", "message"), LINES)
def test_damaged_text(tmp_path, name, text, message):
    path = write_text_model(tmp_path) / f"{name}.txt"
    (tmp_path / "points3D.txt").unlink()
    path.write_text((path.read_text() if name == "cameras" else "") + text)
    with pytest.raises(InputError, match=f"{path}: {message}"):
        read_images(tmp_path)


def test_without_pycolmap(scene, monkeypatch):
    (scene / "pycolmap.py").write_text("raise ImportError('no wheel')\n")
    monkeypatch.syspath_prepend(str(scene))
    with pytest.raises(SetupError, match=r"\(no wheel\); .*'mi-nerfattack\[photos\]'"):
        read_images(scene)
