"""Poses compared after a similarity, and photographs placed anew."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.worlds.views import (
    CAMERA,
    corner_photograph,
    corner_poses,
    write_transforms,
)

from bench import __main__ as bench
from bench.capture import pose_errors

pytestmark = pytest.mark.usefixtures("variant")


def test_errors_after_a_similarity():
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3] = Rotation.random(9, random_state=2).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(9, 3))
    turn = Rotation.from_euler("xyz", [20, 130, -50], True).as_matrix()
    moved = poses.copy()
    moved[:, :3, :3] = turn @ poses[:, :3, :3]
    moved[:, :3, 3] = 0.3 * poses[:, :3, 3] @ turn.T + [5, 6, 7]
    turns, shares = pose_errors(moved, poses)
    assert turns.max() < 1e-4 and shares.max() < 1e-9
    moved[4, :3, :3] = moved[4, :3, :3] @ Rotation.from_rotvec([0, 0.1, 0]).as_matrix()
    assert pose_errors(moved, poses)[0][4] == pytest.approx(np.degrees(0.1))
    # the size of the scene does not count
    moved[:, :3, 3] += rng.normal(0, 0.01, (9, 3))
    first, scaled = pose_errors(moved, poses)[1], poses.copy()
    scaled[:, :3, 3] *= 40
    np.testing.assert_allclose(pose_errors(moved, scaled)[1], first, rtol=1e-6)
    assert first.min() > 0


@pytest.mark.slow
def test_a_corner_is_placed_as_it_was(tmp_path, capsys):
    pytest.importorskip("pycolmap")
    poses = corner_poses()
    images = np.stack([corner_photograph(pose) for pose in poses])
    write_transforms(tmp_path, images, CAMERA, poses)
    bench.main(["poses", str(tmp_path), "-o", str(tmp_path / "work"), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["photographs"] == document["placed"] == len(poses)
    assert document["rotation_deg"] < 1.5 and document["position_share"] < 0.03
