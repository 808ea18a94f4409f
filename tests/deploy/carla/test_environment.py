"""The CARLA environment against a stand-in of client and server; no server runs."""

from __future__ import annotations

import gc
import math
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import carla_stand_in as stand_in
from helpers.carla_stand_in import Server
from helpers.small_fields import homogeneous

from mi_nerfattack.deploy.carla.drivers import Axles, KinematicDriver, PhysicalDriver
from mi_nerfattack.deploy.carla.environment import CarlaEnvironment
from mi_nerfattack.deploy.carla.session import CarlaServer, CarlaSession, load_client
from mi_nerfattack.deploy.kinematic import KinematicVehicle, Motion
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    from_fov,
    mount_matrix,
)
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.system.extras import install_hint
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.route.route import Route

CAMERA = from_fov(8, 6, 90.0)
PERIOD = 0.1
STRAIGHT = Route("straight", 0, np.array([[2.0, 0.0], [90.0, 0.0]]), speed_ms=5.0)

pytestmark = pytest.mark.usefixtures("variant")


def kinematic() -> KinematicDriver:
    return KinematicDriver(KinematicVehicle(Motion(Dubins()), PERIOD, 1.5))


def make(server: Server, driver=None, where=None, **more) -> CarlaEnvironment:
    where = where or CarlaServer(timeout_s=0.2)
    return CarlaEnvironment(
        where,
        more.pop("camera", CAMERA),
        CameraMount(),
        driver or PhysicalDriver(),
        api=server.api(),
        **more,
    )


def test_a_kinematic_drive_is_our_model_and_its_camera():
    server, twin = Server(), KinematicVehicle(Motion(Dubins()), PERIOD, 1.5)
    environment = make(server, kinematic())
    pose = np.array([5.0, 1.0, 0.2])
    frame = environment.reset(STRAIGHT, pose)
    twin.reset(pose, 5.0)
    for control in (0.0, 0.5, -1.0):
        np.testing.assert_allclose(environment.state, twin.state, atol=1e-6)
        expected = mount_matrix(twin.state, CameraMount())[0]
        expected[2, 3] += stand_in.ROAD_HEIGHT
        np.testing.assert_allclose(frame.camera_to_world, expected, atol=1e-6)
        frame = environment.step(control)
        twin.advance(control)
    environment.close()
    assert server.is_as_before


def test_images_are_rgb_and_depth_goes_along_the_rays():
    environment = make(Server())
    frame = environment.reset(STRAIGHT)
    assert frame.image.dtype == np.uint8 and frame.image.shape == (6, 8, 3)
    np.testing.assert_array_equal(frame.image[3, 4], stand_in.COLOUR)
    assert np.isposinf(frame.depth[0]).all()  # sky
    # focal length 4 px: pixel (7, 5) is 3.5 px right and 2.5 px below the centre
    expected = stand_in.WALL * math.sqrt(1 + (3.5 / 4) ** 2 + (2.5 / 4) ** 2)
    assert frame.depth[5, 7] == pytest.approx(expected, rel=1e-5)
    environment.close()


@pytest.mark.parametrize("rate", [0.4, -0.4])
def test_a_heading_rate_is_driven(rate):
    environment = make(Server())
    pose = np.array([5.0, 1.0, 0.2])
    environment.reset(STRAIGHT, pose)
    np.testing.assert_allclose(environment.state, pose, atol=1e-9)
    states = []
    for _ in range(20):
        environment.step(rate)
        states.append(environment.state)
    turned = np.diff(np.array(states)[:, 2]) / PERIOD
    # positive is to the left; the steering follows the speed of the period before
    np.testing.assert_allclose(turned, rate, rtol=0.03)
    speed = np.linalg.norm(np.diff(np.array(states)[:, :2], axis=0), axis=1) / PERIOD
    np.testing.assert_allclose(speed, 5.0, atol=0.2)
    environment.close()


def test_a_second_reset_leaves_no_actor_of_the_first():
    server = Server()
    environment = make(server)
    for _ in range(3):
        environment.reset(STRAIGHT)
        assert len(server.actors) == 3
    environment.close()
    assert server.is_as_before


@pytest.mark.parametrize(("ahead", "is_seen"), [(10.0, True), (25.0, False)])
def test_objects_are_pasted_by_depth(ahead, is_seen):
    environment = make(Server())
    plain = environment.reset(STRAIGHT)
    ball = PosedField(homogeneous(20.0), Pose.upright((2.5 + ahead, 0, 1.0), 0.0, 2.0))
    environment.show([ball])
    frame = environment.reset(STRAIGHT)
    changed = (frame.image != plain.image).any(axis=2)
    nearer = frame.depth < plain.depth
    assert changed[3, 4] == nearer[3, 4] == is_seen
    assert not nearer[3, 0]
    environment.show([])
    np.testing.assert_array_equal(environment.reset(STRAIGHT).image, plain.image)
    environment.close()


class Crossing:
    """A road of 8 m height along x, and one of height 0 across, from x = 44 to 54."""

    name = "Crossing"

    def get_waypoint(self, location):
        above = math.hypot(location.y, location.z - 8)
        aside = max(44 - location.x, location.x - 54, 0.0)
        height = 8.0 if above < math.hypot(aside, location.z) else 0.0
        place = stand_in.Location(location.x, 0.0, height)
        return SimpleNamespace(transform=stand_in.Transform(place))


@pytest.mark.parametrize("axles", [None, Axles(-1.45, 2.9)])
def test_a_kinematic_car_on_a_bridge_stays_on_it(axles):
    environment = make(Server(), kinematic(), axles=axles)
    environment.session.town_map = Crossing()
    poses = [environment.reset(STRAIGHT, STRAIGHT.pose_at(28.0)).camera_to_world]
    for _ in range(80):  # 40 m
        poses.append(environment.step(0.0).camera_to_world)
    assert environment.state[0] == pytest.approx(70.0)
    expected = 8.0 + CameraMount().height_m
    np.testing.assert_allclose(np.array(poses)[:, 2, 3], expected, atol=1e-6)
    environment.close()


def test_synchronous_mode_ticks_once_a_period():
    server = Server()
    environment = make(server, period=0.05)
    assert server.settings.synchronous_mode
    assert server.settings.fixed_delta_seconds == 0.05
    settings = server.settings
    assert settings.max_substeps * settings.max_substep_delta_time >= 0.05
    environment.reset(STRAIGHT)
    before = server.frame
    environment.step(0.0)
    assert server.frame == before + 1
    environment.close()
    environment.close()
    assert server.is_as_before


def test_camera_attributes_reach_the_server():
    server = Server()
    environment = make(server, attributes={"exposure_compensation": "1.5"})
    environment.reset(STRAIGHT)
    colour = next(a for a in server.actors.values() if a.type_id.endswith("rgb"))
    assert colour.attributes["exposure_compensation"] == "1.5"
    assert float(colour.attributes["fov"]) == pytest.approx(90)
    assert colour.attributes["image_size_x"] == "8"
    environment.close()


def test_a_town_is_loaded_with_a_longer_time_limit():
    server = Server()
    environment = make(server, where=CarlaServer(town="Town03", timeout_s=0.2))
    assert server.town == "Town03"
    assert server.time_limits == [0.2, 120.0, 0.2]
    environment.close()
    assert server.is_as_before


LATER = 120  # a frame while the car drives; the server begins with 100


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        (
            {"ends_after": LATER},
            InputError,
            "drive on: time-out.*could not be restor",
        ),
        ({"lost": {LATER}}, InputError, "depth: no image of frame 1.. within 0.2 s"),
        ({"jump": 100}, InputError, "frame 1.. is missing, 2.. came; another"),
        ({"interrupted": LATER}, KeyboardInterrupt, None),
        (
            {"occupied": {"vehicle.tesla.model3"}},
            InputError,
            "cannot be .*; take another",
        ),
        ({"occupied": {"sensor.camera.depth"}}, InputError, "cannot be spawned"),
    ],
)
def test_faults_of_a_drive_give_the_world_back(fault, error, message):
    server = Server()
    environment = make(server)
    vars(server).update(fault)
    with pytest.raises(error, match=message):
        environment.reset(STRAIGHT)
        for _ in range(30):
            environment.step(0.0)
    assert server.is_as_before or "ends_after" in fault
    with pytest.raises(InputError, match="the connection is closed; make another"):
        environment.reset(STRAIGHT)
    environment.close()


@pytest.mark.parametrize(
    ("change", "where", "message"),
    [
        ({"answers": False}, {}, "127.0.0.1:2000: no answer within 0.2 s"),
        ({"version": "0.9.13"}, {}, "server is CARLA 0.9.13, the client 0.9.16"),
        ({}, {"town": "Town99"}, "no town 'Town99'; it has Town01, Town03"),
        ({}, {"weather": "Hail"}, "weather: 'Hail'; one of ClearNoon, CloudyNoon"),
    ],
)
def test_a_connection_that_fails_leaves_nothing(change, where, message):
    server = Server()
    vars(server).update(change)
    with pytest.raises(InputError, match=message):
        make(server, where=CarlaServer(timeout_s=0.2, **where))
    server.answers = True
    assert server.is_as_before


def test_an_environment_that_is_forgotten_gives_the_world_back():
    server = Server()
    environment = make(server)
    environment.reset(STRAIGHT)
    del environment
    gc.collect()
    assert server.is_as_before


def test_a_world_found_in_synchronous_mode_is_released():
    server = Server()
    server.settings.synchronous_mode = True
    make(server).close()
    assert not server.settings.synchronous_mode


def test_closing_a_server_that_is_gone_says_so():
    server = Server()
    environment = make(server)
    server.answers = False
    with pytest.raises(InputError, match="could not be restored.*start the server"):
        environment.close()


def test_a_control_that_is_not_finite_does_not_end_the_connection():
    environment = make(Server())
    with pytest.raises(InputError, match="step comes after reset"):
        environment.step(0.0)
    environment.reset(STRAIGHT)
    with pytest.raises(InputError, match="control: nan"):
        environment.step(math.nan)
    environment.step(0.0)
    environment.close()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"period": 0.2}, "period: 0.2 s; CARLA takes .* at most 0.16"),
        ({"camera": Camera(8, 6, 4, 4, 5, 3)}, "principal point 1, 0 px"),
    ],
)
def test_what_carla_cannot_do_is_refused_before_connecting(more, message):
    server = Server()
    server.answers = False
    with pytest.raises(InputError, match=message):
        make(server, **more)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"vehicle": "vehicle.flying.carpet"}, "no blueprint 'vehicle.flying.carpet'"),
        ({"attributes": {"colour": "red"}}, "rgb: no attribute 'colour'"),
    ],
)
def test_unknown_blueprints_and_attributes(more, message):
    server = Server()
    environment = make(server, **more)
    with pytest.raises(InputError, match=message):
        environment.reset(STRAIGHT)
    assert server.is_as_before


def test_given_axles_are_taken():
    environment = make(Server(), kinematic(), axles=Axles(-1.0, 2.5))
    environment.reset(STRAIGHT)
    # the rear axle is on the route's start, the origin 1 m ahead of it
    actor = environment.session.world.get_snapshot().find(1).get_transform()
    assert actor.location.x == pytest.approx(3.0)
    environment.close()


@pytest.mark.parametrize("text", ["localhost", "a:b", "1.2.3.4:99999", ":2000", "h:0"])
def test_server_addresses_that_are_none(text):
    with pytest.raises(InputError, match="server[.:]"):
        CarlaServer.parse(text)


def test_server_addresses():
    assert CarlaServer.parse("box:2010/Town05") == CarlaServer("box", 2010, "Town05")
    assert CarlaServer.parse("127.0.0.1:2000", weather=None).weather is None


def test_the_client_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(InputError, match=re.escape(install_hint("carla"))):
        load_client()


def test_the_real_client_gives_up_in_time(carla):
    with pytest.raises(InputError, match="127.0.0.1:2999: no answer within 0.3 s"):
        CarlaSession(CarlaServer(port=2999, timeout_s=0.3), 0.1, carla)


def test_images_of_another_size_are_refused():
    server = Server()
    environment = make(server)
    environment.reset(STRAIGHT)
    environment._cameras.camera = from_fov(9, 6, 90.0)
    with pytest.raises(InputError, match="192 bytes; 9 x 6 pixels"):
        environment.step(0.0)
    assert server.is_as_before


def test_the_steering_value_by_hand():
    driver, server = PhysicalDriver(), Server()
    environment = make(server, driver)
    environment.reset(STRAIGHT)
    # atan(2.9 m * 0.5 rad/s / 5 m/s) = 16.172 degrees; at 18 km/h the 70 degrees of
    # the front wheels shrink to 0.91 of them; to the left is negative
    assert driver.steer(0.5, 5.0) == pytest.approx(-16.172 / (70 * 0.91), abs=1e-4)
    assert driver.steer(-50.0, 0.0) == 1.0
    environment.close()


@pytest.mark.parametrize(
    ("count", "scale", "message"),
    [(2, 1.0, r"its wheels are \[\] m ahead"), (4, 50.0, r"wheels are \[-72.5, ")],
)
def test_a_vehicle_that_is_no_car(monkeypatch, count, scale, message):
    whole = stand_in.Vehicle.get_physics_control

    def other(self):
        control = whole(self)
        del control.wheels[count:]
        here = self.get_transform().location
        for wheel in control.wheels:
            place = wheel.position
            place.x = 100 * here.x + scale * (place.x - 100 * here.x)
        return control

    monkeypatch.setattr(stand_in.Vehicle, "get_physics_control", other)
    server = Server()
    environment = make(server)
    with pytest.raises(InputError, match=message):
        environment.reset(STRAIGHT)
    assert server.is_as_before
