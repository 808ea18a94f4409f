"""The height of a car in a town of CARLA where roads cross; no server runs."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.carla_stand_in import Location, Server, Transform

from mi_nerfattack.deploy.car import CAR
from mi_nerfattack.deploy.carla.drivers import Axles, KinematicDriver
from mi_nerfattack.deploy.carla.environment import CarlaEnvironment
from mi_nerfattack.deploy.carla.session import CarlaServer
from mi_nerfattack.deploy.registry import kinematic_vehicle
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.vehicle.route.route import Route

ROUTE = Route("straight", 0, np.array([[2.0, 0.0], [90.0, 0.0]]), speed_ms=5.0)

pytestmark = pytest.mark.usefixtures("variant")


class Crossing:
    """A road of 8 m height along x, and one of height 0 across, from x = 44 to 54."""

    name = "Crossing"

    def get_waypoint(self, location):
        above = math.hypot(location.y, location.z - 8)
        aside = max(44 - location.x, location.x - 54, 0.0)
        height = 8.0 if above < math.hypot(aside, location.z) else 0.0
        return SimpleNamespace(transform=Transform(Location(location.x, 0.0, height)))


@pytest.mark.parametrize("axles", [None, Axles(-1.45, 2.9)])
def test_a_kinematic_car_on_a_bridge_stays_on_it(axles):
    driver, server = KinematicDriver(kinematic_vehicle(CAR, 0.1)), Server()
    environment = CarlaEnvironment(
        CarlaServer(timeout_s=0.2),
        from_fov(8, 6, 90.0),
        CameraMount(),
        driver,
        axles=axles,
        api=server.api(),
    )
    environment.session.town_map = Crossing()
    poses = [environment.reset(ROUTE, ROUTE.pose_at(28.0)).camera_to_world]
    for _ in range(80):  # 40 m
        poses.append(environment.step(0.0).camera_to_world)
    assert environment.state[0] == pytest.approx(70.0)
    expected = 8.0 + CameraMount().height_m
    np.testing.assert_allclose(np.array(poses)[:, 2, 3], expected, atol=1e-6)
    environment.close()
    assert server.is_as_before
