"""The CARLA environment against a stand-in of client and server; no server runs."""

from __future__ import annotations

import dataclasses
import gc
import inspect
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
from support.devices import carla as stand_in
from support.devices.carla import Server
from support.faults.refusals import refusals
from support.worlds.fields import homogeneous

from mi_nerfattack.deploy.carla.drivers import Axles, KinematicDriver
from mi_nerfattack.deploy.carla.environment import CarlaEnvironment
from mi_nerfattack.deploy.carla.session import CarlaServer
from mi_nerfattack.deploy.vehicle import KinematicVehicle, Motion
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.route.route import Route

CAMERA = from_fov(8, 6, 90.0)
ADDRESSES = "localhost", "a:b", "1.2.3.4:99999", ":2000", "h:0"
PERIOD = 0.1
STRAIGHT = Route("straight", 0, np.array([[2.0, 0.0], [90.0, 0.0]]), speed_ms=5.0)

pytestmark = pytest.mark.usefixtures("variant")


def kinematic(ahead: float = 0.0) -> KinematicDriver:
    motion = Motion(Dubins())
    return KinematicDriver(KinematicVehicle(motion, PERIOD, 1.5, reference=ahead))


def make(server: Server, driver=None, where=None, **options) -> CarlaEnvironment:
    where, driver = where or CarlaServer(timeout_s=0.2), driver or kinematic()
    return CarlaEnvironment(
        where, CAMERA, CameraMount(), driver, api=server.api(), **options
    )


@pytest.mark.parametrize("ahead", [0.0, 1.2])
@pytest.mark.parametrize("axles", [None, Axles(-1.0, 2.5)])
def test_a_kinematic_drive_is_our_model_and_its_camera(axles, ahead):
    """On a bridge, 8 m over a road that crosses it from x = 14 on."""
    server, twin = Server(), KinematicVehicle(Motion(Dubins()), PERIOD, 1.5)
    environment = make(server, kinematic(ahead), axles=axles)

    def get_waypoint(location):
        above = math.hypot(location.y, location.z - 8)
        aside = max(14 - location.x, location.x - 24, 0.0)
        height = 8.0 if above < math.hypot(aside, location.z) else 0.0
        place = stand_in.Location(location.x, 0.0, height)
        return SimpleNamespace(transform=stand_in.Transform(place))

    environment.session.town_map.get_waypoint = get_waypoint
    pose = np.array([0.0, 0.0, 0.01])
    frame = environment.reset(STRAIGHT, pose)
    # the reference point is on the pose, the rear axle and the origin from there
    origin = -axles.rear_m if axles else 1.45
    actor = environment.session.world.get_snapshot().find(1).get_transform()
    assert actor.location.x == pytest.approx(origin - ahead, abs=1e-3)
    twin.reset(pose, 5.0)
    for control in (0.0, 0.5, -1.0, 0.5, *[0.0] * 36):  # 20 m
        np.testing.assert_allclose(environment.state, twin.state, atol=1e-5)
        expected = mount_matrix(twin.state, CameraMount())[0]
        expected[2, 3] += 8.0
        np.testing.assert_allclose(frame.camera_to_world, expected, atol=1e-5)
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
    for ahead in (10.0, 25.0):  # an object before and behind the wall
        place = Pose.upright((2.5 + ahead, 0, 1.0), 0.0, 2.0)
        environment.show([PosedField(homogeneous(20.0), place)])
        pasted = environment.reset(STRAIGHT)
        changed = (pasted.image != frame.image).any(axis=2)
        assert changed[3, 4] == (pasted.depth < frame.depth)[3, 4] == (ahead < 20)
    environment.close()


def test_synchronous_mode_ticks_once_a_period():
    server = Server()
    server.settings.synchronous_mode = True  # left so by another program
    attributes = {"exposure_compensation": "1.5"}
    where = dataclasses.replace(CarlaServer.parse("box:2010/Town03"), timeout_s=0.2)
    environment = make(server, where=where, period=0.05, attributes=attributes)
    assert server.town == "Town03" and server.time_limits == [0.2, 120.0, 0.2]
    settings = server.settings
    assert settings.synchronous_mode and settings.fixed_delta_seconds == 0.05
    assert settings.max_substeps * settings.max_substep_delta_time >= 0.05
    for _ in range(2):
        environment.reset(STRAIGHT)
        assert len(server.actors) == 3
    colour = next(a for a in server.actors.values() if a.type_id.endswith("rgb"))
    assert colour.attributes["exposure_compensation"] == "1.5"
    assert float(colour.attributes["fov"]) == pytest.approx(90)
    before = server.frame
    environment.step(0.0)
    assert server.frame == before + 1
    environment.close()
    assert server.is_as_before and not server.settings.synchronous_mode


def test_a_forgotten_environment_gives_the_world_back():
    server = Server()
    environment = make(server)
    environment.reset(STRAIGHT)
    del environment
    gc.collect()
    assert server.is_as_before


LATER = 120  # a frame while the car drives; the server begins with 100


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ({"ends_after": LATER}, InputError, "time-out"),
        ({"lost": {LATER}}, InputError, "depth: no image of frame 1.. within 0.2 s"),
        ({"jump": 100}, InputError, "frame 1.. is missing, 2.. came"),
        ({"interrupted": LATER}, KeyboardInterrupt, None),
        ({"occupied": {"vehicle.tesla.model3"}}, InputError, "spawned"),
        ({"occupied": {"sensor.camera.depth"}}, InputError, "spawned"),
        ({"size": (9, 6)}, InputError, "192 bytes; 9 x 6 pixels"),
    ],
)
def test_faults_of_a_drive_give_the_world_back(fault, error, message):
    server = Server()
    environment = make(server)
    vars(server).update(fault)
    with pytest.raises(error, match=message):
        environment.reset(STRAIGHT)
        if "size" in fault:
            environment._cameras.camera = from_fov(*fault["size"], 90.0)
        for _ in range(30):
            environment.step(0.0)
    assert server.is_as_before or "ends_after" in fault
    with pytest.raises(InputError, match="closed"):
        environment.reset(STRAIGHT)


def drive(where=None, first=None, **options):
    """Reset in a world with a fault, which must be as it was before."""

    def call():
        server = Server()
        vars(server).update(first or {})
        try:
            place = CarlaServer(timeout_s=0.2, **where or {})
            make(server, where=place, **options).reset(STRAIGHT)
        finally:
            server.answers = True
            assert server.is_as_before

    return call


def gone():
    server = Server()
    environment = make(server)
    server.answers = False
    environment.close()


def motorcycle():
    get_physics_control = stand_in.Vehicle.get_physics_control

    def two(self):
        control = get_physics_control(self)
        del control.wheels[2:]
        return control

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stand_in.Vehicle, "get_physics_control", two)
        drive()()


GONE = {"answers": False}
test_what_cannot_be_driven_leaves_nothing = refusals(
    (drive(first=GONE), "127.0.0.1:2000: "),
    (drive(first={"version": "0.9.13"}), "0.9.13, the client 0.9.16"),
    (drive({"town": "Town99"}), "'Town99'; it has Town01, Town03"),
    (drive({"weather": "Hail"}), "weather: 'Hail'; one of ClearNoon, CloudyNoon"),
    (drive(first=GONE, period=0.2), "period: 0.2 s; .* at most 0.16"),  # not asked
    (drive(vehicle="flying.carpet"), "'flying.carpet'"),
    (drive(attributes={"colour": "red"}), "rgb: no attribute 'colour'"),
    (gone, "could not be restored"),
    (motorcycle, r"its wheels are \[\] m ahead"),
    *((lambda t=t: CarlaServer.parse(t), "server[.:]") for t in ADDRESSES),
)


def parameters(function) -> list[str]:
    """Names of the parameters in the docstring of a function of the client."""
    signature = function.__doc__.strip().splitlines()[0].split(" -> ")[0]
    return re.findall(r"\(\w+\)(\w+)", signature)[1:]


MIMICS = [
    item
    for item in vars(stand_in).values()
    if inspect.isclass(item) and item.__module__.startswith("support.devices.carla")
    if item is not stand_in.Server
]


@pytest.mark.parametrize("mimic", MIMICS, ids=lambda item: item.__name__)
def test_the_stand_in_has_nothing_that_the_client_has_not(carla, mimic):
    real, names = getattr(carla, mimic.__name__), set(vars(mimic))
    if dataclasses.is_dataclass(mimic):
        names |= {item.name for item in dataclasses.fields(mimic)}
    assert {name for name in names if not name.startswith("_")} <= set(dir(real))
    for name, value in vars(mimic).items():
        if not inspect.isfunction(value) or name.startswith("_"):
            continue
        ours = list(inspect.signature(value).parameters)[1:]
        theirs = parameters(getattr(real, name))
        assert len(ours) <= len(theirs), name
        for mine, other in zip(ours, theirs, strict=False):
            is_unnamed = re.fullmatch(r"arg\d+", other) or name == "apply_settings"
            assert is_unnamed or mine == other, f"{mimic.__name__}.{name}"
