"""Depth maps in folders, what is unknown in them, and boxes from sparse points."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.posed_folders import write_transforms
from helpers.sphere_views import RADIUS, sphere_views, write_folder
from PIL import Image

from mi_nerfattack.capture.inputs import find_bounds, read_depth
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.transforms import (
    find_transforms,
    read_images,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.fit.loss import LossWeights, _geometry_loss
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.distortion import distort
from mi_nerfattack.render.camera.intrinsics import Camera, look_at
from mi_nerfattack.render.rays import March

pytestmark = pytest.mark.usefixtures("variant")

WALL_M = 2.5  # along the optical axis of every camera
CAMERA = Camera(12, 8, 10.0, 11.0, 6.5, 3.75, k1=0.05, k2=-0.01, p1=1e-3, p2=2e-3)
PINHOLE = Camera(12, 8, 10.0, 11.0, 6.5, 3.75)
FOREIGN = [
    (b"PK\3\4" + bytes(100), "zip archive"),
    (b"\x80\4\x95" + bytes(100), "pickle"),
]


def write_depth_folder(folder: Path, camera: Camera, size=(8, 12)) -> Path:
    """Two views of a wall at right angles to the axis, its upper quarter unknown."""
    poses = np.stack([look_at([0, i, 1.0], [5, i, 1.0]) for i in range(2)])
    images = np.full((2, 8, 12, 3), 99, np.uint8)
    source = write_transforms(folder, images, camera, poses)
    axial = np.full(size, 1000 * WALL_M, np.uint16)
    axial[: size[0] // 4] = 0
    (folder / "depth").mkdir()
    for i in range(2):
        Image.fromarray(axial).save(folder / f"depth/{i}.png")
    edit(source, lambda f, i: f.update(depth_file_path=f"depth/{i}.png"))
    return source


def edit(source: Path, change) -> None:
    table = json.loads(source.read_text())
    for i, frame in enumerate(table["frames"]):
        change(frame, i)
    source.write_text(json.dumps(table))


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


def test_frames_without_depth_are_unknown(tmp_path):
    source = write_depth_folder(tmp_path, PINHOLE)
    edit(source, lambda f, i: i and f.pop("depth_file_path"))
    depth = read_depth(source, read_images(source))
    assert np.isnan(depth[1]).all() and np.isfinite(depth[0, 2:]).all()


def test_depth_follows_the_images_that_are_there(tmp_path):
    source = write_depth_folder(tmp_path, PINHOLE)
    Image.fromarray(np.full((8, 12), 7000, np.uint16)).save(tmp_path / "depth/1.png")
    (tmp_path / "images/0000.png").unlink()
    images = read_images(source, skip_missing=True)
    depth = read_depth(source, images)
    assert depth.shape == (1, 8, 12) and depth.min() >= 7


def test_own_depth_follows_the_images_that_are_there(tmp_path):
    depth = sphere_views(4)[1]
    write_folder(tmp_path, depth)
    (tmp_path / "images/0001.png").unlink()
    images = read_images(tmp_path, skip_missing=True)
    np.testing.assert_array_equal(read_depth(tmp_path, images), depth[[0, 2, 3]])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("depth/none.png", "none.png: does not exist"),
        ("depth/0.npy", r"frames\[0\].depth_file_path: 'depth/0.npy'; must be a PNG"),
        ("images/0000.png", "0000.png: pixel type RGB; must be grey, 16 bits"),
        (5, r"frames\[0\].depth_file_path: 5; needs a path"),
    ],
)
def test_depth_that_cannot_be_read(tmp_path, name, message):
    source = write_depth_folder(tmp_path, PINHOLE)
    edit(source, lambda f, i: f.update(depth_file_path=name))
    with pytest.raises(InputError, match=message):
        read_depth(source, read_images(source))


@pytest.mark.parametrize(("raw", "kind"), FOREIGN)
@pytest.mark.parametrize("key", ["depth_file", "points_file"])
def test_archives_and_pickles_are_not_opened(tmp_path, raw, kind, key):
    source = write_depth_folder(tmp_path, PINHOLE)
    (tmp_path / "a.safetensors").write_bytes(raw)
    images = read_images(source)
    table = json.loads(source.read_text()) | {key: "a.safetensors"}
    source.write_text(json.dumps(table))
    with pytest.raises(InputError, match=f"a.safetensors: is a {kind}"):
        read_depth(source, images) if key == "depth_file" else read_images(source)


def test_images_of_another_folder(tmp_path):
    source = write_depth_folder(tmp_path, PINHOLE)
    with pytest.raises(InputError, match="frames: 2 with an image, but 3 images"):
        read_depth(source, sphere_views(3)[0])


def test_no_depth_without_a_json_file(tmp_path):
    assert read_depth(tmp_path, sphere_views(2)[0]) is None
    with pytest.raises(InputError, match="neither transforms.json"):
        find_transforms(tmp_path)


def test_unknown_depth_has_no_loss():
    seen = March(mi.Color3f(0), mi.Float([0.4, 0.9, 0.4]), mi.Float([0.7, 0.2, 0.7]))
    dr.enable_grad(seen.opacity, seen.moment)
    depth = mi.Float([np.nan, np.nan, 2.0])
    loss = _geometry_loss(seen, depth, LossWeights(depth=10.0, opacity=10.0))
    dr.backward(loss)
    for values in (loss, dr.grad(seen.opacity), dr.grad(seen.moment)):
        unknown = values.numpy()[:2]
        assert not unknown.any() and not np.isnan(unknown).any()
        assert values[2] != 0


class TestBoundsFromPoints:
    def posed(self, points) -> PosedImages:
        return replace(sphere_views(4)[0], points=points)

    def test_outliers_do_not_count(self):
        rng = np.random.default_rng(0)
        points = rng.uniform([-10, -1, -2], [10, 1, 3], (2000, 3))
        points[:20] = 1e6 * rng.normal(size=(20, 3))
        lower, upper = find_bounds(self.posed(points))
        # x: the points without 2 % on either side, about -9.6 to 9.6, then a tenth
        # of the longest edge; y and z: the cameras on a sphere of 1.6 m, or the points
        assert lower[0] == pytest.approx(-9.7 - 1.9, abs=0.4)
        assert upper[0] == pytest.approx(9.7 + 1.9, abs=0.4)
        eyes = self.posed(points).camera_to_world[:, :3, 3]
        assert (lower < eyes.min(0)).all() and (upper > eyes.max(0)).all()
        assert upper[1] == pytest.approx(eyes[:, 1].max() + 1.9, abs=0.2)

    def test_depth_and_given_bounds_win(self):
        posed = self.posed(np.full((5, 3), 40.0))
        lower, upper = find_bounds(posed, sphere_views(4)[1])
        assert upper.max() < RADIUS + 0.1 and lower.min() > -RADIUS - 0.1
        assert find_bounds(posed, None, [0, 0, 0, 1, 1, 1])[1].tolist() == [1, 1, 1]

    def test_points_file(self, tmp_path):
        images, _ = sphere_views(2)
        points = np.arange(6.0).reshape(2, 3)
        files.write_safetensors(tmp_path / "points.safetensors", {"points": points})
        write_transforms(
            tmp_path,
            images.images,
            images.camera,
            images.camera_to_world,
            {"points_file": "points.safetensors"},
        )
        np.testing.assert_array_equal(read_images(tmp_path).points, points)

    @pytest.mark.parametrize(
        ("tensor", "message"),
        [
            (np.zeros((3, 2)), r"shape \(3, 2\)"),
            (np.full((1, 3), np.nan), "holds NaN"),
        ],
    )
    def test_unusable_points_file(self, tmp_path, tensor, message):
        self.test_points_file(tmp_path)
        files.write_safetensors(tmp_path / "points.safetensors", {"points": tensor})
        with pytest.raises(InputError, match=f"points.safetensors: .*{message}"):
            read_images(tmp_path)
