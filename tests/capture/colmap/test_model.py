"""COLMAP models against files written by hand, and against pycolmap's own writer."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from mi_nerfattack.capture.colmap.model import find_model, read_colmap
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera

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


@pytest.fixture(params=[write_text_model, write_binary_model])
def scene(request, tmp_path):
    """A folder with a model in sparse/0 and its images, once in either format."""
    write_photographs(tmp_path / "images")
    request.param(tmp_path / "sparse" / "0")
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


def test_points_fall_on_colmaps_pixels(scene):
    posed = read_images(scene)
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


def test_eye_of_a_quarter_turn(scene):
    posed = read_images(scene)
    # R maps world (x, y, z) to camera (z, y, -x); so the eye is -R^T t
    np.testing.assert_allclose(posed.camera_to_world[1, :3, 3], [4.0, 0.2, -0.3])
    np.testing.assert_allclose(posed.camera_to_world[1, :3, 2], [-1, 0, 0], atol=1e-12)


def test_images_and_points_are_those_of_the_files(scene):
    posed = read_images(scene)
    first = files.read_image(scene / "images" / "a.png")
    np.testing.assert_array_equal(posed.images[0], first)
    np.testing.assert_array_equal(posed.points, POINTS)
    assert posed.unit == "arbitrary"
    assert posed.cameras == (
        Camera(WIDTH, HEIGHT, *PINHOLE),
        Camera(WIDTH, HEIGHT, *OPENCV),
    )


def test_reduction_scales_every_camera(scene):
    posed = read_images(scene, long_edge_px=20)
    assert posed.images.shape == (2, 15, 20, 3)
    assert posed.camera_of(0) == Camera(20, 15, 25.0, 25.5, 10.0, 7.5)
    assert posed.camera_of(1).cx == 10.25


def test_text_and_binary_are_one(tmp_path):
    photographs = write_photographs(tmp_path / "images")
    posed = []
    for write in (write_text_model, write_binary_model):
        root = tmp_path / write.__name__
        write(root)
        shutil.copytree(photographs, root / "images")
        posed.append(read_colmap(root))
    text, binary = posed
    np.testing.assert_array_equal(text.camera_to_world, binary.camera_to_world)
    np.testing.assert_array_equal(text.points, binary.points)
    assert text.cameras == binary.cameras and text.names == binary.names


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_model_that_pycolmap_wrote(tmp_path, suffix):
    pycolmap = pytest.importorskip("pycolmap")
    source = pycolmap.Reconstruction()
    source.read_text(str(write_text_model(tmp_path / "source")))
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (source.write_binary if suffix == "bin" else source.write_text)(str(model))
    assert (model / f"cameras.{suffix}").is_file()
    write_photographs(tmp_path / "images")
    posed = read_colmap(tmp_path)
    np.testing.assert_allclose(np.sort(posed.points, 0), np.sort(POINTS, 0))
    for name, matrix in zip(posed.names, posed.camera_to_world, strict=True):
        image = next(i for i in source.images.values() if i.name == name)
        to_world = image.cam_from_world().inverse().matrix()
        np.testing.assert_allclose(matrix[:3], to_world, atol=1e-12)


@pytest.mark.parametrize(
    ("model", "images"),
    [
        (".", "images"),
        (".", "."),
        ("sparse", "images"),
        ("sparse/0", "images"),
        ("sparse/0", "sparse/0"),
        ("colmap/sparse/0", "images"),
        ("colmap/sparse/0", "colmap/images"),
    ],
)
def test_places(tmp_path, model, images):
    write_text_model(tmp_path / model)
    write_photographs(tmp_path / images)
    assert find_model(tmp_path) == tmp_path / model
    assert len(read_images(tmp_path)) == 2


def test_model_folder_alone_finds_images_above(scene):
    assert len(read_images(scene / "sparse" / "0")) == 2


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
    with pytest.raises(InputError, match="b.png: 4 x 3 px, but .*a.png has 40 x 30"):
        read_images(scene)
    files.write_image(scene / "images/a.png", np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(
        InputError, match=r"a.png: 4 x 3 px.*cameras.(txt|bin).*40 x 30"
    ):
        read_images(scene)


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match="no posed images; looked for .*sparse/0"):
        read_images(tmp_path)
    write_photographs(tmp_path / "images")
    with pytest.raises(InputError, match="2 photographs.*mi-nerfattack poses"):
        read_images(tmp_path)
    with pytest.raises(InputError, match="nowhere: does not exist"):
        read_images(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no COLMAP model"):
        read_colmap(tmp_path)


class TestDamagedText:
    @pytest.mark.parametrize(
        ("name", "text", "message"),
        [
            ("cameras.txt", "1 OPENCV 40", "line 1: 3 fields; needs CAMERA_ID"),
            ("cameras.txt", "1 OPENCV 40 30 1 2", "camera 1: .*2 parameters"),
            ("cameras.txt", "1 PINHOLE 4.5 30 1 1 1 1", "line 1: .*whole numbers"),
            ("cameras.txt", "1 PINHOLE 40 30 nan 1 1 1", "line 1: .*finite"),
            ("cameras.txt", "1 PINHOLE 40 30 -1 1 1 1", "camera 1: camera.fx: -1"),
            ("cameras.txt", "1 FOV 40 30 1 1 1 1 1", "camera 1: model FOV.*undistort"),
            ("images.txt", "1 1 0 0 0 0 0", "line 1: 7 fields; needs IMAGE_ID"),
            ("images.txt", "1 1 0 0 0 0 0 0 9 a.png", "'a.png': camera 9 is not in"),
            ("images.txt", "1 0 0 0 0 0 0 0 1 a.png", "'a.png': pose .*zero"),
            ("images.txt", "1 1 0 0 0 nan 0 0 1 a.png", "line 1: .*finite"),
            ("images.txt", "# none", "holds no image"),
            ("images.txt", 2 * "1 1 0 0 0 0 0 0 1 a.png\n\n", "'a.png' occurs 2"),
            ("points3D.txt", "1 x 0 0 1 2 3 4", "line 1: 'x 0 0'; must be numbers"),
        ],
    )
    def test_message(self, tmp_path, name, text, message):
        write_text_model(tmp_path)
        write_photographs(tmp_path)
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=f"{name}: .*{message}"):
            read_images(tmp_path)


class TestDamagedBinary:
    @pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
    def test_every_truncation_is_refused(self, tmp_path, name):
        write_binary_model(tmp_path)
        write_photographs(tmp_path)
        raw = (tmp_path / name).read_bytes()
        for length in range(len(raw)):
            (tmp_path / name).write_bytes(raw[:length])
            with pytest.raises(InputError, match=f"{name}: byte"):
                read_images(tmp_path)
        (tmp_path / name).write_bytes(raw + b"\0")
        with pytest.raises(InputError, match=f"{name}: 1 bytes after the last"):
            read_images(tmp_path)

    @pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
    def test_garbage(self, tmp_path, name, rng):
        write_binary_model(tmp_path)
        write_photographs(tmp_path)
        for number in 5 * (1, 2, 1 << 40, (1 << 64) - 1):
            count = struct.pack("<Q", number)
            (tmp_path / name).write_bytes(count + rng.bytes(300))
            with pytest.raises(InputError, match=name):
                read_images(tmp_path)

    @pytest.mark.parametrize(
        ("model_id", "message"),
        [(5, "model OPENCV_FISHEYE; only .*PINHOLE"), (99, "model number 99")],
    )
    def test_other_models_by_name(self, tmp_path, model_id, message):
        write_binary_model(tmp_path)
        camera = struct.pack("<QiiQQ8d", 1, 3, model_id, WIDTH, HEIGHT, *OPENCV)
        (tmp_path / "cameras.bin").write_bytes(camera)
        with pytest.raises(InputError, match=f"cameras.bin: camera 3: {message}"):
            read_images(tmp_path)


def test_model_numbers_are_colmaps():
    pycolmap = pytest.importorskip("pycolmap")
    from mi_nerfattack.capture.colmap import binary as colmap_binary

    members = {int(v): k for k, v in pycolmap.CameraModelId.__members__.items()}
    known = {i: name for i, name in members.items() if i >= 0}
    assert dict(enumerate(colmap_binary._MODELS)) == known
