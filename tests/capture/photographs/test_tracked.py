"""Motion capture of a body on the camera: scale, world and mount that it gives."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_nerfattack import cli
from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.photographs.alignment import align
from mi_nerfattack.capture.photographs.tracked import Tracked, fit_tracked, read_tracked
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import from_fov

COUNT = 24
SCALE = 0.37
WORLD = Rotation.from_euler("zyx", [70, -20, 35], True)
ORIGIN = np.array([2.0, -3.0, 0.5])
MOUNT = Rotation.from_euler("zyx", [-90, 5, 88], True)
LEVER = np.array([0.04, -0.11, 0.07])


def walked(turns: np.ndarray, noise: float = 0.0) -> tuple[Structure, Tracked]:
    """Walk with turns (n, 3), radians; return what both see of it.

    Args:
        turns: rotation vectors of the body.
        noise: of the tracker's places, metres.
    """
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
    found = Structure(names, poses[1], lens, np.zeros((1, 3)), 0.5)
    return found, Tracked("poses.csv", dict(zip(names, poses[0], strict=True)))


def all_ways() -> np.ndarray:
    t = np.linspace(0, 1, COUNT)[:, None]
    return np.sin(t * [5.0, 7.0, 4.0] + [0.0, 1.0, 2.0]) * [0.3, 0.4, 1.2]


def test_exact_without_noise(tmp_path):
    found, tracked = walked(all_ways())
    moved, scale = align(found, Path(), tracked)
    fit = scale.tracked
    assert fit.scale == pytest.approx(SCALE) and fit.photographs == COUNT
    mount = np.array(fit.camera_to_body)
    np.testing.assert_allclose(mount[:3, 3], LEVER, atol=1e-6)
    np.testing.assert_allclose(mount[:3, :3], MOUNT.as_matrix(), atol=1e-6)
    assert max(fit.residual_m, fit.residual_deg) < 1e-5
    body = np.stack(list(tracked.body_to_world.values()))
    np.testing.assert_allclose(moved.camera_to_world, body @ mount, atol=1e-6)
    np.testing.assert_allclose(moved.points, [ORIGIN], atol=1e-6)
    files.write_json(tmp_path / "scale.json", asdict(scale))


def test_noise_and_outliers_of_a_tracker():
    found, tracked = walked(all_ways(), 0.003)
    body = dict(tracked.body_to_world)
    wrong = body["07.jpg"].copy()
    wrong[:3, 3] += 0.8  # another body was taken for it
    body["07.jpg"] = wrong
    fit = fit_tracked(found, replace(tracked, body_to_world=body))
    assert fit.scale == pytest.approx(SCALE, rel=3e-3)
    np.testing.assert_allclose(fit.translation, ORIGIN, atol=0.015)
    assert 0.2 < fit.residual_m < 0.35  # shows that something is wrong


def test_what_does_not_tell():
    flat = all_ways() * [0, 0, 1]
    with pytest.raises(InputError, match="about one axis at most.*tilt or roll"):
        fit_tracked(*walked(flat))
    found, tracked = walked(all_ways())
    few = dict(list(tracked.body_to_world.items())[:5])
    with pytest.raises(InputError, match="poses of 5 of 24 placed"):
        fit_tracked(found, replace(tracked, body_to_world=few))
    names, poses = zip(*tracked.body_to_world.items(), strict=True)
    late = dict(zip(names, poses[8:] + poses[:8], strict=True))
    with pytest.raises(InputError, match="clocks"):
        fit_tracked(found, replace(tracked, body_to_world=late))


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


def test_file_without_what_is_needed(tmp_path, capsys):
    (tmp_path / "walk.mp4").write_bytes(b"no film")
    path = tmp_path / "rig.csv"
    arguments = [str(tmp_path / "walk.mp4"), "-o", str(tmp_path / "out")]
    arguments += ["--camera-poses", str(path)]
    for header, video, message in (
        ("file", True, "needs time_s"),
        ("time_s", False, "add 'file'"),
    ):
        path.write_text(f"{header},x_m,y_m,z_m,qw,qx,qy,qz\n1,1,2,3,1,0,0,0\n")
        if video:
            assert cli.main(["capture", *arguments]) == cli.EXIT_INPUT
            assert message in capsys.readouterr().err
        else:
            with pytest.raises(InputError, match=message):
                read_tracked(path)
