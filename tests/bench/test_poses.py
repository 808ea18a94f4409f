"""Poses compared after a similarity, and photographs placed anew."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.corner import CAMERA, corner_photograph, corner_poses
from helpers.posed_folders import write_transforms
from scipy.spatial.transform import Rotation

from bench import __main__ as bench
from bench.photographs import KINDS, on_side, pose_errors, write_mixed
from mi_nerfattack.capture.photographs.staging import copy_upright
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.distortion import distort
from mi_nerfattack.render.camera.intrinsics import Camera

pytestmark = pytest.mark.usefixtures("variant")


def test_errors_after_a_similarity():
    rng = np.random.default_rng(1)
    given = np.tile(np.eye(4), (9, 1, 1))
    given[:, :3, :3] = Rotation.random(9, random_state=2).as_matrix()
    given[:, :3, 3] = rng.normal(size=(9, 3))
    turn = Rotation.from_euler("xyz", [20, 130, -50], True).as_matrix()
    found = given.copy()
    found[:, :3, :3] = turn @ given[:, :3, :3]
    found[:, :3, 3] = 0.3 * given[:, :3, 3] @ turn.T + [5, 6, 7]
    turns, shares = pose_errors(found, given)
    assert turns.max() < 1e-4 and shares.max() < 1e-9
    found[4, :3, :3] = found[4, :3, :3] @ Rotation.from_rotvec([0, 0.1, 0]).as_matrix()
    assert pose_errors(found, given)[0][4] == pytest.approx(np.degrees(0.1))
    # the size of the scene does not count
    found[:, :3, 3] += rng.normal(0, 0.01, (9, 3))
    first, scaled = pose_errors(found, given)[1], given.copy()
    scaled[:, :3, 3] *= 40
    np.testing.assert_allclose(pose_errors(found, scaled)[1], first, rtol=1e-6)
    assert first.min() > 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_mixed_photograph_is_what_its_camera_sees(kind, tmp_path):
    camera = Camera(240, 180, 208.0, 205.0, 117.0, 93.0)
    pose = corner_poses()[2]
    image = corner_photograph(pose, camera)
    shown, seen_by, moved = write_mixed(tmp_path / "a.jpg", image, camera, pose, kind)
    held = copy_upright(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert (held.width, held.height) == (seen_by.width, seen_by.height)
    stored = files.read_image(tmp_path / "b.jpg").astype(float)
    assert np.abs(stored - shown).mean() < 3
    wanted = corner_photograph(moved, seen_by).astype(float)
    # enlarged by 1.5, its finest detail is lost
    assert np.abs(shown - wanted).mean() < (12 if kind == "zoomed" else 0.5)
    off = np.abs(shown - np.roll(wanted, 3, axis=1)).mean()
    assert off > 2 * np.abs(shown - wanted).mean()


def test_a_camera_on_its_side_distorts_as_before():
    camera = Camera(240, 180, 208.0, 205.0, 117.0, 93.0, 0.1, -0.05, 0.01, -0.02)
    turned = on_side(camera)

    def pixel(of: Camera, x: float, y: float) -> np.ndarray:
        x, y = distort(x, y, *of.distortion)
        return np.array([of.fx * x + of.cx, of.fy * y + of.cy])

    u, v = pixel(camera, 0.3, -0.2)
    np.testing.assert_allclose(pixel(turned, -0.2, -0.3), [v, 240 - u])


@pytest.mark.slow
def test_fox_turned_and_zoomed_is_placed_whole(data_folder, tmp_path, capsys):
    """Twenty photographs of 480 px, held four ways, at two focal lengths."""
    pytest.importorskip("pycolmap")
    given = read_images(data_folder / "fox", 480, skip_missing=True)
    chosen = np.arange(4, 24)
    poses = given.camera_to_world[chosen]
    write_transforms(tmp_path, given.images[chosen], given.camera, poses)
    assert bench.main(["poses", str(tmp_path), "--mixed", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["placed"] == found["photographs"] == 20
    assert found["focal_most_share"] < 0.03


@pytest.mark.slow
def test_a_corner_is_placed_as_it_was(tmp_path, capsys):
    pytest.importorskip("pycolmap")
    poses = corner_poses()
    images = np.stack([corner_photograph(pose) for pose in poses])
    write_transforms(tmp_path, images, CAMERA, poses)
    bench.main(["poses", str(tmp_path), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["photographs"] == found["placed"] == len(poses)
    assert found["rotation_deg"] < 1.5 and found["position_share"] < 0.03
