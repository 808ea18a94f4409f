"""Motion capture of a body on the camera: scale, world and mount that it gives."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.faults.refusals import refusals

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.photographs.alignment import align, upright
from mi_nerfattack.capture.photographs.tracked import Tracked, fit_tracked, read_tracked
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov

pytestmark = pytest.mark.usefixtures("variant")

COUNT = 24
SCALE = 0.37
WORLD = Rotation.from_euler("zyx", [70, -20, 35], True)
ORIGIN = np.array([2.0, -3.0, 0.5])
MOUNT = Rotation.from_euler("zyx", [-90, 5, 88], True)
LEVER = np.array([0.04, -0.11, 0.07])


def walked(turns: np.ndarray, noise: float = 0.0) -> tuple[Structure, Tracked]:
    """Walk with turns (n, 3), radians, and noise in metres; return what both see."""
    t = np.linspace(0, 1, COUNT)
    places = np.stack([2 * np.cos(5 * t), 2 * np.sin(5 * t), 1.2 + 0.3 * t], 1)
    body = Rotation.from_rotvec(turns)
    camera, eyes = body * MOUNT, places + body.apply(LEVER)
    poses = np.tile(np.eye(4), (2, COUNT, 1, 1))
    poses[0, :, :3, :3], poses[0, :, :3, 3] = body.as_matrix(), places
    poses[0, :, :3, 3] += np.random.default_rng(2).normal(0, noise, (COUNT, 3))
    poses[1, :, :3, :3] = (WORLD.inv() * camera).as_matrix()
    poses[1, :, :3, 3] = WORLD.inv().apply(eyes - ORIGIN) / SCALE
    names = tuple(f"{i:02d}.jpg" for i in range(COUNT))
    lens = (from_fov(8, 6, 60.0),) * COUNT
    reconstruction = Structure(names, poses[1], lens, np.zeros((1, 3)), 0.5)
    return reconstruction, Tracked("poses.csv", dict(zip(names, poses[0], strict=True)))


def all_ways() -> np.ndarray:
    t = np.linspace(0, 1, COUNT)[:, None]
    return np.sin(t * [5.0, 7.0, 4.0] + [0.0, 1.0, 2.0]) * [0.3, 0.4, 1.2]


def test_exact_without_noise():
    reconstruction, tracked = walked(all_ways())
    moved, scale = align(reconstruction, Path(), tracked)
    fit = scale.tracked
    assert fit.scale == pytest.approx(SCALE) and fit.photographs == COUNT
    mount = np.array(fit.camera_to_body)
    np.testing.assert_allclose(mount[:3, 3], LEVER, atol=1e-6)
    np.testing.assert_allclose(mount[:3, :3], MOUNT.as_matrix(), atol=1e-6)
    assert max(fit.residual_m, fit.residual_deg) < 1e-5
    body = np.stack(list(tracked.body_to_world.values()))
    np.testing.assert_allclose(moved.camera_to_world, body @ mount, atol=1e-6)
    np.testing.assert_allclose(moved.points, [ORIGIN], atol=1e-6)
    json.dumps(asdict(scale))  # as it is written


def test_noise_and_outliers_of_a_tracker():
    reconstruction, tracked = walked(all_ways(), 0.003)
    body = dict(tracked.body_to_world)
    wrong = body["07.jpg"].copy()
    wrong[:3, 3] += 0.8  # another body was taken for it
    body["07.jpg"] = wrong
    fit = fit_tracked(reconstruction, replace(tracked, body_to_world=body))
    assert fit.scale == pytest.approx(SCALE, rel=3e-3)
    np.testing.assert_allclose(fit.translation, ORIGIN, atol=0.015)
    assert 0.2 < fit.residual_m < 0.35  # shows that something is wrong


def fit_changed(change) -> None:
    """Fit to the poses of other names."""
    reconstruction, tracked = walked(all_ways())
    names, poses = (
        list(part) for part in zip(*tracked.body_to_world.items(), strict=True)
    )
    body = dict(zip(*change(names, poses), strict=True))
    fit_tracked(reconstruction, replace(tracked, body_to_world=body))


test_refused = refusals(
    (lambda: fit_tracked(*walked(all_ways() * [0, 0, 1])), "poses.csv: .*one axis"),
    (lambda: fit_changed(lambda n, p: (n[:5], p[:5])), "poses.csv: .* 5 of 24"),
    (lambda: fit_changed(lambda n, p: (n, p[8:] + p[:8])), "poses.csv: .*clocks"),
    (lambda: upright(structure(OPPOSITE), 1.0), "photographs: .*directions cancel"),
)


HEADER = "time_s,file,x_m,y_m,z_m,qw,qx,qy,qz\n"


def test_poses_between_times(tmp_path):
    path = tmp_path / "rig.csv"
    quarter = Rotation.from_rotvec([0, 0, 0.2]).as_quat(scalar_first=True)
    turned = ",".join(map(str, quarter))
    rows = ["0.0,a,1,2,3,1,0,0,0", f"0.05,b,2,2,3,{turned}", "0.4,c,9,9,9,1,0,0,0"]
    path.write_text(HEADER + "\n".join(rows) + "\n")
    times = {"x.jpg": 0.02, "gap.jpg": 0.2, "after.jpg": 0.5}
    (pose,) = read_tracked(path, times).body_to_world.values()
    np.testing.assert_allclose(pose[:3, 3], [1.4, 2, 3])
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turn, [0, 0, 0.08], atol=1e-9)
    assert list(read_tracked(path).body_to_world) == ["a", "b", "c"]
    for missing, frame_times in (("time_s", times), ("file", None)):
        path.write_text(HEADER.replace(f"{missing},", "") + "1,1,2,3,1,0,0,0\n")
        with pytest.raises(InputError, match=f"{path}: .*{missing}"):
            read_tracked(path, frame_times)


def test_poses_of_heic_are_those_of_their_copies(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text(HEADER + "0,taken/a.HEIC,1,2,3,1,0,0,0\n0,b.jpg,1,2,3,1,0,0,0\n")
    assert list(read_tracked(path).body_to_world) == ["a.HEIC.jpg", "b.jpg"]


OPPOSITE = np.stack([np.eye(4), np.diag([1.0, -1, -1, 1])])


def structure(poses) -> Structure:
    names = tuple(str(i) for i in range(len(poses)))
    cameras = (from_fov(240, 180, 60.0),) * len(poses)
    return Structure(names, poses, cameras, np.zeros((0, 3)), 0.5)


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [0.3, -0.8, 0.2]])
def test_any_up_becomes_z(up):
    up = np.array(up, float) / np.linalg.norm(up)
    side = np.cross(up, [0.36, 0.48, 0.8])
    side /= np.linalg.norm(side)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3] = np.stack([side, -up, np.cross(side, -up)], axis=1)
    poses[1, :3, 3] = [2, 4, 4]
    upright_poses = upright(structure(poses), 0.5).camera_to_world
    np.testing.assert_allclose(upright_poses[:, :3, 1], [[0, 0, -1]] * 2, atol=1e-12)
    eyes = upright_poses[:, :3, 3]
    np.testing.assert_allclose(eyes.sum(0), 0, atol=1e-12)
    assert np.linalg.norm(eyes[1] - eyes[0]) == pytest.approx(3)  # half of 6
    assert np.linalg.det(upright_poses[0]) == pytest.approx(1)
