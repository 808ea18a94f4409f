"""Views of a scene along its routes: where from, and what is written."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mi_nerfattack.capture.scene import capture_scene, drive_poses
from mi_nerfattack.capture.transforms import read_transforms
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")


def straight_route() -> Route:
    points = np.stack([np.arange(0, 20.5, 0.5), np.zeros(41)], axis=1)
    return Route("straight", 0, points)


class TestDrivePoses:
    def test_spread(self):
        poses = drive_poses([straight_route()], 400, seed=1)
        forward = poses[:, :3, 2]
        eyes = poses[:, :3, 3]
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

    def test_narrow_lanes_and_loops(self):
        """What surrounds a lane is in proportion, and a loop has no ends."""
        corners = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
        loop = Route("loop", 0, corners, lane_width_m=0.6, closed=True)
        mount = CameraMount(0.2, 0.0, 0.0)
        eyes = drive_poses([loop], 400, seed=1, mount=mount)[:, :3, 3]
        away = np.abs(eyes[:, :2] - 1).max(1) - 1
        assert 0.5 < np.abs(away).max() <= 0.3 + 0.6 * 3 / 7 + 1e-9

    def test_reproducible(self):
        route = straight_route()
        first, second = (drive_poses([route], 5, seed=3) for _ in range(2))
        np.testing.assert_array_equal(first, second)
        with pytest.raises(InputError, match="0 routes"):
            drive_poses([], 5, seed=3)
        with pytest.raises(InputError, match="seed: -1; at least 0"):
            drive_poses([route], 5, seed=-1)


def test_capture_scene(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>'
        '<shape type="rectangle"><transform name="to_world"><scale value="100"/>'
        "</transform></shape></scene>"
    )
    route = {
        "goal": 0,
        "lane_width_m": 3.5,
        "speed_ms": 5.0,
        "points_m": straight_route().points.tolist(),
    }
    (tmp_path / "routes.json").write_text(json.dumps({"straight": route}))
    out, seen = tmp_path / "out", []
    path = capture_scene(
        scene,
        tmp_path / "routes.json",
        out,
        3,
        from_fov(16, 8, 90.0),
        4,
        seed=0,
        progress=lambda done, total: seen.append((done, total)),
    )
    read = read_transforms(path)
    assert seen == [(1, 3), (2, 3), (3, 3)] and read.images.shape == (3, 8, 16, 3)
    depth = files.read_safetensors(out / "depth.safetensors")[0]["depth"]
    height = read.camera_to_world[:, 2, 3]
    # the ray through the bottom row hits the ground, z = 0
    bottom = np.isfinite(depth[:, -1, 8])
    np.testing.assert_array_less(height[bottom], depth[bottom, -1, 8])

    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # other views replace the first ones
        capture_scene(
            scene, tmp_path / "routes.json", out, 3, read.camera, 4, 1, interrupt
        )
    assert not path.exists()


def test_no_view_is_taken_from_within_what_stands_beside_the_lane(tmp_path):
    """A block along the left side from 0.4 m on, where views reach 0.56 m."""
    scene = """<scene version="3.0.0"><integrator type="path"/>
    <emitter type="constant"/><shape type="cube"><transform name="to_world">
    <scale x="30" y="1" z="{height}"/><translate y="1.4"/></transform></shape>
    </scene>"""
    points = straight_route().points.tolist()
    route = {"goal": 0, "lane_width_m": 0.6, "speed_ms": 1.0, "points_m": points}
    (tmp_path / "routes.json").write_text(json.dumps({"straight": route}))
    for name, height in (("low", 0.01), ("high", 2)):
        (tmp_path / f"{name}.xml").write_text(scene.format(height=height))
        path = capture_scene(
            tmp_path / f"{name}.xml",
            tmp_path / "routes.json",
            tmp_path / name,
            80,
            from_fov(2, 1, 90.0),
            1,
            seed=0,
            mount=CameraMount(0.2, 0.0, 10.0),
        )
        eyes = read_transforms(path).camera_to_world[:, :3, 3]
        assert 0.2 * 4 / 7 <= eyes[:, 2].min() and eyes[:, 2].max() <= 0.2 * 15 / 7
        assert (eyes[:, 1] > 0.4).any() == (name == "low")
