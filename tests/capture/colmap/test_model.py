"""COLMAP models against files written by hand."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from mi_nerfattack.capture.colmap.model import MAX_BYTES, find_model, read_colmap
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


def write_photographs(folder: Path, names=tuple(POSES)) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(3)
    for name in names:
        image = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        files.write_image(folder / name, image)
    return folder


@pytest.fixture
def scene(tmp_path):
    """A folder with a model in sparse/0 and its images."""
    write_photographs(tmp_path / "images")
    write_text_model(tmp_path / "sparse" / "0")
    return tmp_path


def colmap_projection(q, t, point, parameters):
    """COLMAP's documented formulas, written out: rotate, divide, distort, scale."""
    w, x, y, z = np.array(q) / np.linalg.norm(q)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    a, b, c = rotation @ point + t
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
    for index, name in enumerate(posed.names):
        q, t, camera_id = POSES[name]
        parameters = OPENCV if camera_id == 1 else PINHOLE
        for point in POINTS:
            expected = colmap_projection(q, t, np.array(point), parameters)
            found = our_pixel(
                posed.camera_of(index), posed.camera_to_world[index], point
            )
            np.testing.assert_allclose(found, expected, atol=1e-6)
    # R maps world (x, y, z) to camera (z, y, -x); so the eye is -R^T t
    np.testing.assert_allclose(posed.camera_to_world[1, :3, 3], [4.0, 0.2, -0.3])
    np.testing.assert_allclose(posed.camera_to_world[1, :3, 2], [-1, 0, 0], atol=1e-12)
    first = files.read_image(tmp_path / "images" / "a.png")
    np.testing.assert_array_equal(posed.images[0], first)
    np.testing.assert_array_equal(posed.points, POINTS)
    assert posed.unit == "arbitrary"
    assert posed.cameras == (
        Camera(WIDTH, HEIGHT, *PINHOLE),
        Camera(WIDTH, HEIGHT, *OPENCV),
    )


def test_reduction_scales_every_camera(scene):
    (scene / "sparse/0/points3D.txt").unlink()
    posed = read_images(scene, long_edge_px=20)
    assert posed.images.shape == (2, 15, 20, 3)
    assert posed.camera_of(0) == Camera(20, 15, 25.0, 25.5, 10.0, 7.5)
    assert posed.camera_of(1).cx == 10.25
    assert posed.points is None


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


def test_transforms_come_first(scene):
    (scene / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match="transforms.json: frames: missing"):
        read_images(scene)


def test_missing_images(scene):
    (scene / "images" / "b.png").unlink()
    with pytest.raises(
        InputError, match="images.(txt|bin): 1 of 2 .*'b.png'.*--skip-m"
    ):
        read_images(scene)
    posed = read_images(scene, skip_missing=True)
    assert posed.names == ("a.png",) and posed.missing == ("b.png",)
    assert posed.cameras == () and posed.camera == Camera(WIDTH, HEIGHT, *PINHOLE)
    (scene / "images" / "a.png").unlink()
    with pytest.raises(InputError, match="none of the 2 images.*'a.png'.*looked in"):
        read_images(scene, skip_missing=True)


def test_image_of_another_size(scene):
    files.write_image(scene / "images/b.png", np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(
        InputError, match=r"b.png: 4 x 3 px.*cameras.(txt|bin).*40 x 30"
    ):
        read_images(scene)


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match="no posed images; looked for .*sparse/0"):
        read_images(tmp_path)
    write_photographs(tmp_path / "images")
    with pytest.raises(InputError, match="2 photographs.*mi-nerfattack capture"):
        read_images(tmp_path)
    with pytest.raises(InputError, match="nowhere: does not exist"):
        read_images(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no COLMAP model"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras", "3 OPENCV 40", "Check failed.*copy it again"),
        ("cameras", "3 PINHOLE 40 30 -1 1 1 1", "camera 3: camera.fx: -1"),
        ("images", "1 1 0 0 0 nan 0 0 1 a.png\n\n", "Check failed.*copy it again"),
        ("images", "1 0 0 0 0 0 0 0 1 a.png\n\n", "'a.png': quaternion.*zero"),
        ("images", "1 1 0 0 0 0 0 0 1 a\x07.png", "unprintable"),
        (
            "images",
            "1 1 0 0 0 0 0 0 1 a b.png",
            "11 words .names with blanks need .bin",
        ),
        ("images", "# none", "holds no image"),
        ("images", "1 1 0 0 0 0 0 0 1 a\n\n2 1 0 0 0 0 0 0 1 a\n\n", "'a' occurs 2"),
        ("points3D", "1 1 2 3 1 2 3 4 7 0", "7 does not exist.*copy it again"),
    ],
)
def test_damaged_text(tmp_path, name, text, message):
    write_text_model(tmp_path)
    if name == "cameras":
        text = (tmp_path / "cameras.txt").read_text() + text
    if name == "images":
        (tmp_path / "points3D.txt").unlink()
    (tmp_path / f"{name}.txt").write_text(text)
    with pytest.raises(InputError, match=f"{name}.txt: .*{message}"):
        read_images(tmp_path)


@pytest.mark.parametrize(
    ("name", "left"),
    [
        ("cameras.bin", -1),
        ("cameras.bin", "more"),
        ("images.bin", 0),
        ("images.bin", 12),
        ("images.bin", -1),
        ("points3D.bin", 0),
        ("points3D.bin", 40),
        ("points3D.bin", -1),
    ],
)
def test_truncated_binary(tmp_path, name, left):
    write_binary_model(tmp_path)
    raw = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(raw + b"\0" if left == "more" else raw[:left])
    with pytest.raises(InputError, match=f"{name}: .*copy it again"):
        read_images(tmp_path)


@pytest.mark.slow
def test_track_without_end(tmp_path):
    """COLMAP would read it for hours."""
    write_binary_model(tmp_path)
    point = struct.pack("<QQ3d3BdQ", 1, 0, *POINTS[0], 1, 2, 3, 0.5, 1 << 62)
    (tmp_path / "points3D.bin").write_bytes(point)
    with pytest.raises(InputError, match="points3D.bin: .*copy it again"):
        read_images(tmp_path)


@pytest.mark.parametrize(
    ("model_id", "message"),
    [(5, "camera 3: model OPENCV_FISHEYE; only .*PINHOLE"), (99, "model does not exi")],
)
def test_other_models(tmp_path, model_id, message):
    write_binary_model(tmp_path)
    camera = struct.pack("<QiiQQ8d", 1, 3, model_id, WIDTH, HEIGHT, *OPENCV)
    (tmp_path / "cameras.bin").write_bytes(camera)
    (tmp_path / "images.bin").write_bytes(bytes(8))
    (tmp_path / "points3D.bin").unlink()
    with pytest.raises(InputError, match=f"cameras.bin: .*{message}"):
        read_images(tmp_path)


def test_too_large(tmp_path):
    write_binary_model(tmp_path)
    with (tmp_path / "images.bin").open("r+b") as file:
        file.truncate(MAX_BYTES + 1)  # sparse: takes no room
    with pytest.raises(InputError, match="images.bin: .*bytes"):
        read_images(tmp_path)


def test_without_pycolmap(scene, monkeypatch):
    (scene / "pycolmap.py").write_text("raise ImportError('no wheel')\n")
    monkeypatch.syspath_prepend(str(scene))
    with pytest.raises(SetupError, match="no wheel; .*pip install pycolmap"):
        read_images(scene)
