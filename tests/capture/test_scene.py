"""Views of a scene along its routes: where from, and what is written."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.faults.refusals import refusals

from mi_nerfattack.capture.scene import capture_scene, drive_poses, is_begun
from mi_nerfattack.capture.transforms import read_transforms
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")


def straight_route() -> Route:
    points = np.stack([np.arange(0, 20.5, 0.5), np.zeros(41)], axis=1)
    return Route("straight", 0, points)


def test_spread():
    poses = drive_poses([straight_route()], 400, seed=1)
    forward, eyes = poses[:, :3, 2], poses[:, :3, 3]
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    lateral = eyes[:, 1] - 0.5 * np.sin(heading)  # the mount is 0.5 m ahead
    along = eyes[:, 0] - 0.5 * np.cos(heading)
    assert 3.1 < np.abs(lateral).max() <= 3.25  # 1.5 m beside a lane of 3.5 m
    assert np.mean(np.abs(lateral) <= 1.75) == pytest.approx(0.82, abs=0.06)
    assert -1.5 <= along.min() < -1 and 21 < along.max() <= 21.5
    assert (np.abs(heading) > np.pi / 2).mean() == pytest.approx(0.15, abs=0.06)
    as_mounted = np.isclose(eyes[:, 2], 1.4)
    assert as_mounted.mean() == pytest.approx(0.7, abs=0.08)
    assert eyes[:, 2].min() >= 0.8 and eyes[:, 2].max() <= 3
    again = drive_poses([straight_route()], 400, seed=1)
    np.testing.assert_array_equal(poses, again)


test_refused = refusals(
    (lambda: drive_poses([], 5, seed=3), "0 routes"),
    (lambda: drive_poses([straight_route()], 5, seed=-1), "seed: -1"),
)


def test_spread_beside_narrow_lanes_and_loops():
    """What surrounds a lane is in proportion, and a loop has no ends."""
    corners = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
    loop = Route("loop", 0, corners, lane_width_m=0.6, closed=True)
    mount = CameraMount(0.2, 0.0, 0.0)
    eyes = drive_poses([loop], 400, seed=1, mount=mount)[:, :3, 3]
    away = np.abs(eyes[:, :2] - 1).max(1) - 1
    assert 0.5 < np.abs(away).max() <= 0.3 + 0.6 * 3 / 7 + 1e-9


def write_world(folder: Path, place: str = "", extra: str = "", **route) -> list[Path]:
    """Write a floor of 200 m with a straight route, and return their paths."""
    (folder / "scene.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>'
        '<shape type="rectangle"><transform name="to_world"><scale value="100"/>'
        f"{place}</transform></shape>{extra}</scene>"
    )
    points = straight_route().points.tolist()
    route = {
        "goal": 0,
        "lane_width_m": 3.5,
        "speed_ms": 5.0,
        "points_m": points,
    } | route
    (folder / "routes.json").write_text(json.dumps({"straight": route}))
    return [folder / "scene.xml", folder / "routes.json"]


def test_capture_scene(tmp_path):
    out, calls, lens = tmp_path / "out", [], from_fov(16, 8, 90.0)
    capture = partial(capture_scene, *write_world(tmp_path))
    path = capture(out, 3, lens, 4, 0, lambda *call: calls.append(call))
    read = read_transforms(path)
    assert calls == [(1, 3), (2, 3), (3, 3)] and read.images.shape == (3, 8, 16, 3)
    depth = files.read_safetensors(out / "depth.safetensors")[0]["depth"]
    height = read.camera_to_world[:, 2, 3]
    # the ray through the bottom row hits the ground, z = 0
    bottom = np.isfinite(depth[:, -1, 8])
    np.testing.assert_array_less(height[bottom], depth[bottom, -1, 8])

    times_ns = {file: file.stat().st_mtime_ns for file in out.rglob("*.*")}
    assert len(times_ns) == 5  # three images, their depth and their poses
    assert capture(out, 3, lens, 4, 0) == path
    assert times_ns == {file: file.stat().st_mtime_ns for file in out.rglob("*.*")}
    with pytest.raises(InputError, match=r"capture\.seed: 0 -> 1"):
        capture(out, 3, lens, 4, 1)

    def interrupt(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    again = tmp_path / "again"
    with pytest.raises(KeyboardInterrupt):
        capture(again, 3, lens, 4, 0, interrupt)
    assert is_begun(again) and len(list(again.glob("views/*"))) == 2
    capture(again, 3, lens, 4, 0)
    assert not (again / "views").exists()
    for file in times_ns:
        assert (again / file.relative_to(out)).read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ('<rotate x="1" angle="-90"/>', "z -100 to 100"),  # y up
        ('<translate x="150"/>', "scene.xml .*x 50 to 250"),
        ('<translate z="-0.5"/>', "0.50 m below"),
    ],
)
def test_routes_without_ground_are_refused_before_a_view_is_rendered(
    tmp_path, place, message
):
    # within the floor where y is up
    paths = write_world(tmp_path, place, points_m=[[0.0, 0.0], [20.0, 0.0]])
    with pytest.raises(InputError, match=f"routes.json: .*{message}"):
        capture_scene(*paths, tmp_path / "out", 3, from_fov(16, 8, 90.0), 4, seed=0)
    assert not (tmp_path / "out").exists()


def test_no_view_is_taken_from_within_what_stands_beside_the_lane(tmp_path):
    """A block along the left side from 0.4 m on, where views reach 0.56 m."""
    for height in (0.01, 2):
        block = (
            '<shape type="cube"><transform name="to_world">'
            f'<scale x="30" z="{height}"/><translate y="1.4"/></transform></shape>'
        )
        paths = write_world(tmp_path, "", block, lane_width_m=0.6, speed_ms=1.0)
        lens, mount = from_fov(2, 1, 90.0), CameraMount(0.2, 0.0, 10.0)
        out = tmp_path / str(height)
        path = capture_scene(*paths, out, 80, lens, 1, seed=0, mount=mount)
        eyes = read_transforms(path).camera_to_world[:, :3, 3]
        assert 0.2 * 4 / 7 <= eyes[:, 2].min() and eyes[:, 2].max() <= 0.2 * 15 / 7
        assert (eyes[:, 1] > 0.4).any() == (height < 0.2)
