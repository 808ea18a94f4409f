"""Depth maps in folders, what is unknown in them, and boxes from sparse points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.faults.refusals import refusals
from support.worlds.views import sphere_views, write_folder, write_transforms

from mi_nerfattack.capture.inputs import find_bounds, read_depth
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.transforms import find_transforms, read_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import exr, files
from mi_nerfattack.render.camera.distortion import distort
from mi_nerfattack.render.camera.intrinsics import Camera, look_at

pytestmark = pytest.mark.usefixtures("variant")

WALL_M = 2.5  # along the optical axis of every camera
CAMERA = Camera(12, 8, 10.0, 11.0, 6.5, 3.75, k1=0.05, k2=-0.01, p1=1e-3, p2=2e-3)
PINHOLE = Camera(12, 8, 10.0, 11.0, 6.5, 3.75)


def write_depth_folder(folder: Path, camera: Camera, size=(8, 12), count=2) -> Path:
    """Views of a wall at right angles to the axis, its upper quarter unknown."""
    poses = np.stack([look_at([0, i, 1.0], [5, i, 1.0]) for i in range(count)])
    images = np.full((count, 8, 12, 3), 99, np.uint8)
    source = write_transforms(folder, images, camera, poses)
    axial = np.full(size, 1000 * WALL_M, np.uint16)
    axial[: size[0] // 4] = 0
    (folder / "depth").mkdir()
    for i in range(count):
        Image.fromarray(axial).save(folder / f"depth/{i}.png")
    edit(source, lambda f, i: f.update(depth_file_path=f"depth/{i}.png"))
    return source


def edit(source: Path, change=lambda frame, i: None, **keys) -> None:
    """Change the frames of a table, and add keys to it."""
    table = files.read_json(source) | keys
    for i, frame in enumerate(table["frames"]):
        change(frame, i)
    files.write_json(source, table)


@pytest.mark.parametrize("size", [(8, 12), (16, 24), (4, 6)])
@pytest.mark.parametrize("camera", [PINHOLE, CAMERA])
def test_axial_millimetres_become_metres_along_the_ray(tmp_path, camera, size):
    write_depth_folder(tmp_path, camera, size)
    images = read_images(tmp_path)
    depth = read_depth(tmp_path, images)
    assert depth.dtype == np.float32 and depth.shape == (2, 8, 12)
    unknown = np.isnan(depth[0])
    assert unknown[:2].all() and not unknown[2:].any()
    # a point on the wall, forwards through the lens, is seen where its depth is
    row, column, step = 5, 9, 1e-5
    x = (column + 0.5 - camera.cx) / camera.fx
    y = (row + 0.5 - camera.cy) / camera.fy
    for _ in range(50):  # fixed point, instead of the Newton steps that are tested
        u, v = distort(x, y, *camera.distortion)
        x -= u - (column + 0.5 - camera.cx) / camera.fx
        y -= v - (row + 0.5 - camera.cy) / camera.fy
    expected = WALL_M * np.linalg.norm([x, y, 1])
    assert depth[0, row, column] == pytest.approx(expected, rel=step)


@pytest.mark.parametrize("kind", ["exr", "exr RGB", "npy", "npy f2", "npy u2"])
def test_depth_in_metres_is_read(tmp_path, kind):
    source = write_depth_folder(tmp_path, PINHOLE)
    expected = read_depth(tmp_path, read_images(tmp_path))
    axial = np.full((8, 12), WALL_M)
    axial[:2], axial[7, 0] = 0, np.inf
    for i in range(2):
        if kind.startswith("exr"):
            colours = {"": np.ones((8, 12, 3))} if kind == "exr RGB" else {}
            name = "depth.Z" if colours else "depth.V"
            depth = np.minimum(axial, 1e10)  # as Blender says infinity
            exr.write_layers(tmp_path / f"depth/{i}.exr", {name: depth, **colours})
        else:
            values = np.minimum(1000 * axial, 60_000) if kind == "npy u2" else axial
            np.save(tmp_path / f"depth/{i}.npy", values.astype(kind[4:] or "f8"))
    edit(source, lambda f, i: f.update(depth_file_path=f"depth/{i}.{kind[:3]}"))
    depth = read_depth(source, read_images(source))
    if kind != "npy u2":
        assert np.isinf(depth[:, 7, 0]).all()
    expected[:, 7, 0] = depth[:, 7, 0]
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


@pytest.mark.parametrize("own", [True, False])
def test_depth_follows_the_images_that_are_there(tmp_path, own):
    if own:
        source, expected = tmp_path, sphere_views(4)[1]
        write_folder(tmp_path, expected)
    else:
        source = write_depth_folder(tmp_path, PINHOLE, count=3)
        far = Image.fromarray(np.full((8, 12), 7000, np.uint16))
        far.save(tmp_path / "depth/1.png")
        edit(source, lambda f, i: i == 2 and f.pop("depth_file_path"))
        expected = read_depth(source, read_images(source))
        assert expected[1].min() >= 7 and np.isnan(expected[2]).all()
    (tmp_path / "images/0000.png").unlink()
    images = read_images(source, skip_missing=True)
    np.testing.assert_array_equal(read_depth(source, images), expected[1:])


def test_a_folder_without_a_table_has_no_depth(tmp_path):
    assert read_depth(tmp_path, POSES) is None


NPY = b"\x93NUMPY\1\0v\0{'descr': '%s', 'fortran_order': False, 'shape': (%s), }"
HUGE, OBJECTS = NPY % (b"<f4", b"99999999, 99999999"), NPY % (b"|O", b"1, 1")
KEY, NOT_A_PLANE = "depth_file_path", "not a NumPy file"
#: As nerfstudio reads .npy by default; a sky of infinity does not count.
MILLIMETRES = np.full((8, 12), 1000 * WALL_M)
MILLIMETRES[:5] = np.inf


@pytest.mark.parametrize(
    ("key", "value", "content", "message"),
    [
        (KEY, "depth/a.npy", b"\x93NUMPY", f"a.npy: {NOT_A_PLANE}"),
        (KEY, "depth/a.npy", HUGE.ljust(128), f"a.npy: {NOT_A_PLANE}"),
        (KEY, "depth/a.npy", OBJECTS.ljust(136), f"a.npy: {NOT_A_PLANE}"),
        (KEY, "depth/a.npy", MILLIMETRES, "a.npy: .*by 1000"),
        (KEY, "depth/0.npz", b"", r"frames\[0\].depth_file_path: 'depth/0.npz'"),
        (KEY, "images/0000.png", b"", "0000.png: .*RGB.*16"),
        (KEY, 5, b"", r"frames\[0\].depth_file_path: 5"),
        ("depth_file", "a", b"PK\3\4" + bytes(100), "a: is a zip archive"),
        ("points_file", "a", b"\x80\4\x95" + bytes(100), "a: is a pickle"),
        ("points_file", "a", {"points": np.zeros((3, 2))}, r"a: .*\(3, 2\)"),
        ("points_file", "a", {"points": np.full((1, 3), np.nan)}, "a: .*NaN"),
        ("applied_transform", [[1, 2], [3, 4]], b"", "applied_transform: .*3 x 4"),
    ],
)
def test_what_cannot_be_read(tmp_path, key, value, content, message):
    source = write_depth_folder(tmp_path, PINHOLE)
    if isinstance(content, dict):
        files.write_safetensors(tmp_path / value, content)
    elif isinstance(content, np.ndarray):
        np.save(tmp_path / value, content)
    elif content:
        (tmp_path / value).write_bytes(content)
    if key == KEY:
        edit(source, lambda f, i: f.update({key: value}))
    else:
        points = write_points(tmp_path, np.zeros((50, 3)))
        edit(source, ply_file_path=points, **{key: value})
    with pytest.raises(InputError, match=message):
        read_depth(source, read_images(source))


def other_images(folder: Path) -> None:
    read_depth(write_depth_folder(folder, PINHOLE), sphere_views(3)[0])


test_refused = refusals(
    (find_transforms, "neither transforms.json"),
    (other_images, "transforms.json: frames: 2 .* 3 images"),
)


def write_points(folder: Path, points: np.ndarray) -> str:
    """Write points as nerfstudio does, and return the file's name."""
    rows = "".join(f"{x:.9g} {y:.9g} {z:.9g} 1 2 3\n" for x, y, z in points)
    colours = "".join(f"property uint8 {c}\n" for c in ("red", "green", "blue"))
    (folder / "sparse_pc.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\n"
        f"property float y\nproperty float z\n{colours}end_header\n{rows}"
    )
    return "sparse_pc.ply"


POSES = sphere_views(4)[0]


def test_outliers_of_points_do_not_count_for_bounds():
    rng = np.random.default_rng(0)
    points = rng.uniform([-10, -1, -2], [10, 1, 3], (2000, 3))
    points[:20] = 1e6 * rng.normal(size=(20, 3))
    lower, upper = find_bounds(replace(POSES, points=points))
    # x: the points without 2 % on either side, about -9.6 to 9.6, then a tenth
    # of the longest edge; y and z: the cameras on a sphere of 1.6 m, or the points
    assert lower[0] == pytest.approx(-9.7 - 1.9, abs=0.4)
    assert upper[0] == pytest.approx(9.7 + 1.9, abs=0.4)
    eyes = POSES.camera_to_world[:, :3, 3]
    assert (lower < eyes.min(0)).all() and (upper > eyes.max(0)).all()
    assert upper[1] == pytest.approx(eyes[:, 1].max() + 1.9, abs=0.2)


def write_posed(folder: Path, **keys) -> PosedImages:
    poses = POSES.camera_to_world
    write_transforms(folder, POSES.images, POSES.camera, poses, keys)
    return read_images(folder)


def test_points_file(tmp_path):
    points = np.arange(6.0).reshape(2, 3)
    for stored, expected in ((points, points), (points[:0], None)):
        files.write_safetensors(tmp_path / "p.safetensors", {"points": stored})
        read_points = write_posed(tmp_path, points_file="p.safetensors").points
        np.testing.assert_array_equal(read_points, expected)


@pytest.mark.parametrize("is_turned", [True, False])
def test_points_of_nerfstudio(tmp_path, is_turned, rng):
    points = rng.normal(scale=0.1, size=(50, 3))
    turn = np.c_[[[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], [1.0, -4, 2]]
    stored = points if is_turned else (points - turn[:, 3]) @ turn[:, :3]
    keys = {"applied_transform": turn.tolist()}
    images = write_posed(tmp_path, ply_file_path=write_points(tmp_path, stored), **keys)
    np.testing.assert_allclose(images.points, points, atol=1e-6)
    keys["ply_file_path"] = write_points(tmp_path, points[:0])
    assert write_posed(tmp_path, **keys).points is None
