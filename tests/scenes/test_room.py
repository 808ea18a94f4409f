"""The bundled room: its plan, its loop, its pictures."""

from __future__ import annotations

import json
import math

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.io.files import read_image
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.pathtrace.views import ViewRenderer
from mi_nerfattack.scenes import bundled
from mi_nerfattack.scenes.room import build, layout
from mi_nerfattack.vehicle.route.route import Route

STRAIGHT = 2 * (layout.TRACK_HALF - layout.CORNER_RADIUS)
LENGTH = 4 * STRAIGHT + 2 * math.pi * layout.CORNER_RADIUS
#: By which 70 chords of an arc of radius r are shorter: s^3 / 24 / r^2 each.
CHORDS = 70 * 0.1**3 / 24 / layout.CORNER_RADIUS**2


def test_builds_to_what_is_bundled(tmp_path) -> None:
    """Not to the bytes: zlib's depend on its version, a sine's on the processor."""
    for path in build.build(tmp_path, seed=5):
        kept = bundled(f"room/{path.relative_to(tmp_path).as_posix()}")
        if path.suffix == ".png":
            one, two = (read_image(item).astype(int) for item in (path, kept))
            assert np.abs(one - two).max() <= 1
        elif path.suffix == ".ply":
            one, two = (trimesh.load_mesh(item, process=False) for item in (path, kept))
            np.testing.assert_allclose(one.vertices, two.vertices, atol=1e-6)
            np.testing.assert_array_equal(one.faces, two.faces)
        elif path.suffix == ".json":
            one, two = (json.loads(item.read_text())["square"] for item in (path, kept))
            points = [entry.pop("points_m") for entry in (one, two)]
            np.testing.assert_allclose(*points, atol=2e-6)
            assert one == two
        else:
            assert path.read_bytes() == kept.read_bytes()


class TestLoop:
    def test_route_is_closed_and_even(self) -> None:
        entry = json.loads(bundled("room/routes.json").read_text())["square"]
        assert entry["closed"] is True and entry["goal"] == 0
        points = np.array(entry["points_m"])
        step = np.roll(points, -1, axis=0) - points
        length = np.linalg.norm(step, axis=1)
        # a chord of an arc is shorter by at most s^3 / 24 / r^2
        assert length.max() - length.min() < 0.11**3 / 24 / layout.CORNER_RADIUS**2
        assert length.sum() == pytest.approx(LENGTH, abs=CHORDS)
        heading = np.arctan2(step[:, 1], step[:, 0])
        turn = np.remainder(np.roll(heading, -1) - heading + np.pi, 2 * np.pi) - np.pi
        assert turn.sum() == pytest.approx(2 * np.pi)
        assert 0 - 1e-5 <= turn.min()
        assert turn.max() < 0.101 / layout.CORNER_RADIUS

    def test_points_lie_on_the_track(self) -> None:
        x, y = layout.track().T
        np.testing.assert_allclose(layout.track_distance(x, y), 0, atol=1e-12)
        assert (x[0], y[0]) == (-0.5 * STRAIGHT, -layout.TRACK_HALF)

    @pytest.mark.parametrize(
        ("x", "y", "expected"),
        [(0, -1.6, 0), (0, 2, 0.4), (-1.5, 0.2, -0.1), (0, 0, -1.6), (1.6, 1.6, None)],
    )
    def test_distance(self, x, y, expected) -> None:
        if expected is None:  # beyond the corner, whose centre is (0.5, 0.5)
            expected = math.hypot(1.1, 1.1) - 1.1
        distance = layout.track_distance(np.array(float(x)), np.array(float(y)))
        assert distance == pytest.approx(expected)

    def test_reader_and_car(self) -> None:
        route = Route.from_file(bundled("room/routes.json"), "square")
        assert route.closed and route.length == pytest.approx(LENGTH, abs=CHORDS)
        steer = math.atan(SMALL_CAR.wheelbase / layout.CORNER_RADIUS)
        assert steer < 0.9 * SMALL_CAR.max_steer


@pytest.fixture
def scene(variant: str) -> mi.Scene:
    return load_scene(bundled("room/scene.xml"))


def test_nothing_stands_near_the_lane(scene) -> None:
    """From above: 0.2 m beside the lane there is floor."""
    grid = np.arange(-2.4, 2.41, 0.05)
    x, y = (a.ravel() for a in np.meshgrid(grid, grid))
    near = np.abs(layout.track_distance(x, y)) < 0.5 * layout.LANE_WIDTH + 0.2
    origin = np.stack([x[near], y[near], np.full(near.sum(), 2.6)]).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(0, 0, -1))
    t = scene.ray_intersect_preliminary(ray).t.numpy()
    np.testing.assert_allclose(t, 2.6, atol=1e-5)


def test_tape_is_green_where_the_loop_is(scene) -> None:
    points = layout.track()[::7]
    normal = np.roll(layout.track(), -1, 0)[::7] - points
    normal = np.stack([-normal[:, 1], normal[:, 0]], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def albedo(offset: float) -> np.ndarray:
        place = points + offset * normal
        origin = np.column_stack([place, np.ones(len(place))]).T
        ray = mi.Ray3f(
            mi.Point3f(np.ascontiguousarray(origin, np.float32)),
            mi.Vector3f(0, 0, -1),
        )
        si = scene.ray_intersect(ray)
        return np.array(si.bsdf().eval_diffuse_reflectance(si)).T

    for offset in (-0.015, 0.0, 0.015):
        red, green, blue = albedo(offset).T
        assert np.all(green > 3 * red) and np.all(green > 3 * blue)
    for offset in (-0.06, 0.06):
        assert np.all(np.ptp(albedo(offset), axis=1) < 0.1)


@pytest.mark.slow
def test_pictures_from_the_car(scene) -> None:
    """Exposed, the tape ahead, little noise at 16 samples, and no two sides alike."""
    renderer = ViewRenderer(scene, from_fov(100, 52, 90.0))
    mount = CameraMount(0.3, 0.3, 10.0)
    states = [
        (-0.2, -1.6, 0.0),
        (1.6, -0.2, 0.5 * np.pi),
        (0.2, 1.6, np.pi),
        (-1.6, 0.2, -0.5 * np.pi),
    ]
    images = []
    for pose in mount_matrix(np.array(states), mount):
        view = renderer.render(pose, 16, 0)
        assert np.isfinite(view.depth).all()
        assert 0.1 < view.rgb.mean() < 0.5
        assert np.mean(view.rgb > 1) < 0.02
        red, green, blue = np.moveaxis(view.rgb[-12:], -1, 0)
        assert 20 < np.sum((green > 2.5 * red) & (green > 2.5 * blue)) < 300
        images.append(linear_to_uint8(view.rgb).astype(float))
    # two pictures with noise of their own
    other = linear_to_uint8(renderer.render(pose, 16, 1).rgb)
    assert np.sqrt(0.5 * np.mean((images[-1] - other) ** 2)) < 9
    for i in range(4):
        for j in range(i):
            assert np.abs(images[i] - images[j])[:40].mean() > 15
