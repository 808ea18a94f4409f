"""The bundled scenario of the room: its camera, its car and where its cube stands."""

from __future__ import annotations

import numpy as np
import pytest

from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.rollout.drive import departure_limit
from mi_nerfattack.scenario.scenario import Scenario, load_scenario
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(bundled("room.toml"))[0]


@pytest.fixture(scope="module")
def route() -> Route:
    return Route.from_file(bundled_place("room").routes, "square")


def test_the_policy_sees_the_picture_that_it_was_trained_with(scenario) -> None:
    """The rows that are kept, at 200x66, within half a pixel of 66 rows."""
    camera, mount = scenario.camera.build()
    place, keys = bundled_place("room"), scenario.policy.preprocess
    assert (camera.width, camera.height) == (336, 188) and mount == place.mount
    top, bottom, left, right = keys.crop_px
    width, height = camera.width - left - right, camera.height - top - bottom
    kept = Camera(
        width, height, camera.fx, camera.fy, camera.cx - left, camera.cy - top
    )
    seen, wanted = kept.resized(*keys.resize_px), place.camera
    assert (seen.width, seen.height) == (wanted.width, wanted.height)
    assert (seen.cx, seen.cy) == pytest.approx((wanted.cx, wanted.cy))
    assert seen.fx == pytest.approx(wanted.fx)
    # rows are squeezed by so little that the outermost moves by less than half a pixel
    assert abs(seen.fy / wanted.fy - 1) * wanted.height / 2 < 0.5


def test_the_car_is_the_small_one_and_starts_in_its_lane(scenario, route) -> None:
    car = scenario.vehicle.car()
    assert car.wheelbase == SMALL_CAR.wheelbase and car.width == SMALL_CAR.width
    assert car.max_control == pytest.approx(SMALL_CAR.max_control, abs=1e-5)
    assert car.control_unit == scenario.policy.unit() == "rad"
    assert scenario.vehicle.speed_ms == route.speed_ms
    limit = departure_limit(route.lane_width_m, car.width)
    assert limit == pytest.approx(0.152) and scenario.drive.lateral_sd_m < limit / 5
    assert scenario.drive.runs > 1 and scenario.attack.poses > 1


def test_the_cube_stands_beside_the_corner(scenario, route) -> None:
    """All of its foot off the lane, within what training has shown of cubes."""
    (cube,) = scenario.objects
    half = cube.scale / 2  # the bundled cube has edges of 1 m
    corners = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    feet = np.asarray(cube.position_m[:2]) + corners
    states = np.column_stack([feet, np.zeros(4)])
    away = np.abs(route.cross_track_numpy(states)) - route.lane_width_m / 2
    assert away.min() == pytest.approx(0.11, abs=0.01)
    arc, _, _ = route.project_numpy(states[:1] + [[half, half, 0]])
    assert 1.0 < arc[0] < 2.73 < scenario.drive.length_m  # along the first corner
