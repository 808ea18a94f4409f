"""Views, vehicles and the registry that pairs them, against geometry."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support.faults.refusals import refusals
from support.reference.derivatives import nothing_compiled
from support.worlds.fields import blob, small_ngp
from support.worlds.places import blank_environment, write_place

from mi_nerfattack.backend.colour import (
    linear_to_srgb_numpy,
    linear_to_uint8,
    srgb_to_linear_numpy,
)
from mi_nerfattack.deploy.car import CAR, SMALL_CAR
from mi_nerfattack.deploy.place import Conditions, bundled_place
from mi_nerfattack.deploy.registry import kinematic_vehicle, make_environment
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.deploy.vehicle import KinematicVehicle, Motion
from mi_nerfattack.deploy.views.mitsuba import MitsubaView
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, look_at
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.render.pathtrace.load import DAYLIGHT, set_daylight
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.dynamics import Dubins, to_state
from mi_nerfattack.vehicle.route.route import Route, load_routes

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = from_fov(16, 8, 90.0)
WALL = """<scene version="3.0.0">
  <integrator type="path"/>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="2"/><rotate y="1" angle="-90"/><translate x="5"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="0.2"/></emitter>
  </shape>
</scene>"""
SUN = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="2"/></integrator>
  <emitter type="sunsky" id="light">
    <vector name="sun_direction" value="0, 0.1, 1"/></emitter>
  <shape type="rectangle"><transform name="to_world"><scale value="50"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf></shape>
  <shape type="rectangle"><transform name="to_world">
    <scale value="0.5"/><translate z="3"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
</scene>"""

DOME = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="3"/></integrator>
  <emitter type="constant"/><shape type="sphere"><bsdf type="diffuse"/></shape>
</scene>"""


def a_route() -> Route:
    return Route("straight", 0, np.array([[0.0, 0.0], [50.0, 0.0]]))


def test_camera_rides_on_the_vehicle():
    environment = blank_environment(
        CameraMount(height_m=1.5, forward_m=2.0, pitch_deg=30.0)
    )
    frame = environment.reset(a_route(), np.array([3.0, 4.0, math.pi / 2]), 7)
    down = math.radians(30)
    expected = np.eye(4)
    expected[:3, 0] = 1, 0, 0  # right of a vehicle that drives to +y
    expected[:3, 1] = 0, -math.sin(down), -math.cos(down)
    expected[:3, 2] = 0, math.cos(down), -math.sin(down)
    expected[:3, 3] = 3, 6, 1.5
    assert np.allclose(frame.camera_to_world, expected, atol=1e-12)
    frame = environment.step(0.0)
    expected[1, 3] += 0.5  # 5 m/s for 0.1 s
    assert np.allclose(frame.camera_to_world, expected, atol=1e-6)
    small = kinematic_vehicle(bundled_place("room"))
    small.reset(np.zeros(3), 1.0)
    for _ in range(10):
        small.advance(0.1)
    assert small.control_unit == "rad"  # an angle, held for a second
    turned = math.tan(0.1) / SMALL_CAR.wheelbase
    assert small.state[2] == pytest.approx(turned, rel=1e-3)


def test_every_frame_has_a_seed_of_its_own_that_follows_from_the_drives():
    seeds = []
    for drive in (3, 3, 4):
        environment = blank_environment()
        environment.reset(a_route(), None, drive)
        environment.step(0.0)
        seeds.append(environment.views[0].seeds)
    assert seeds[0] == seeds[1] and len({*seeds[0], *seeds[2]}) == 4


def test_surrogate_shows_what_the_sensor_of_attacks_sees():
    mount, state = CameraMount(0.2, 0.0, 5.0), np.array([[-3.0, 0.4, -0.1]])
    scene = PosedField(small_ngp())
    objects = [PosedField(blob(np.random.default_rng(0)), Pose.upright((1, 0, 0), 0.3))]
    vehicle = KinematicVehicle(Motion(Dubins()), 0.1, 1.5)
    environment = SurrogateEnvironment(field_sensor(scene, [], CAMERA, mount), vehicle)
    for shown in ([], objects):
        environment.show(shown)
        frame = environment.reset(a_route(), state[0])
        sensor = field_sensor(scene, shown, CAMERA, mount)
        expected = sensor.observe(to_state(state), 0).image.numpy()[0]
        assert (frame.image == np.round(255 * expected)).all()
    assert frame.image.std() > 5
    assert np.isinf(frame.depth).any() and np.isfinite(frame.depth).any()
    layers = frame.layers(["ball"])
    layer_names = ("scene", "ball", "background")
    assert set(layers) == {
        "",
        "Z",
        *layer_names,
        *(f"{name}.Z" for name in layer_names),
    }
    total = sum(layers[name] for name in layer_names)
    assert abs(total - layers[""]).max() < 1e-6
    assert min(layers[name][..., 3].max() for name in layer_names) > 0.1
    assert (linear_to_uint8(layers[""][..., :3]) == frame.image).mean() > 0.99


@pytest.mark.parametrize("exposure_ev", [0.0, 1.0, -2.0])
def test_wall_of_known_radiance_at_known_distance(exposure_ev):
    view = MitsubaView(mi.load_string(WALL), CAMERA, 7, exposure_ev)
    frame = view.render(look_at((0, 0, 0), (1, 0, 0)), 3)
    level = round(255 * (1.055 * (0.2 * 2.0**exposure_ev) ** (1 / 2.4) - 0.055))
    x = (np.arange(16)[None] + 0.5 - 8) / 8 * 5  # metres on the wall, which is 4 m wide
    y = (np.arange(8)[:, None] + 0.5 - 4) / 8 * 5
    on_wall, lengths = (abs(x) < 2) & (abs(y) < 2), np.sqrt(25 + x**2 + y**2)
    assert np.isinf(frame.depth[~on_wall]).all()
    assert np.allclose(frame.depth[on_wall], lengths[on_wall], rtol=1e-5)
    inner = on_wall[1:-1, 1:-1] & on_wall[1:-1, 2:] & on_wall[1:-1, :-2]
    assert (abs(frame.image[1:-1, 1:-1][inner].astype(int) - level) <= 1).all()
    assert (frame.image[:, 0] == 0).all()


@pytest.mark.parametrize("name", ["surrogate", "mitsuba"])
def test_a_camera_blurs_light_and_adds_noise_to_values(name, tmp_path):
    place, conditions = write_place(tmp_path), Conditions(spp=1)
    clear = make_environment(name, place, conditions).reset(a_route(), None, 5)
    worse = replace(conditions, blur_px=1.5, noise_sd=0.05)
    environment = make_environment(name, place, worse)
    frame = environment.reset(a_route(), None, 5)
    light = srgb_to_linear_numpy(clear.image / 255)
    blurred = gaussian_filter(light, (1.5, 1.5, 0), mode="reflect")
    noise = frame.image / 255 - linear_to_srgb_numpy(blurred)
    unclipped = noise[(frame.image > 0) & (frame.image < 255)]
    assert unclipped.std() == pytest.approx(0.05, rel=0.15)
    assert unclipped.size > 200 and abs(unclipped.mean()) < 0.01
    assert (frame.depth == clear.depth).all()
    assert (environment.reset(a_route(), None, 6).image != frame.image).any()
    environment.show([PosedField(blob(np.random.default_rng(0)))])
    environment.reset(a_route(), None, 5)
    environment.step(0.4)  # the first moves the vehicle, by a kernel of its own
    environment.reset(a_route(), None, 5)
    with nothing_compiled():
        for control in (0.4, -0.2, 0.3):
            expected = environment.step(control)
        environment.reset(a_route(), None, 5)
        for control in (0.4, -0.2):  # periods without a look
            environment.advance(control)
        frame = environment.step(0.3)
    assert (frame.image == expected.image).all() and frame.image.max() > 20
    assert (frame.camera_to_world == expected.camera_to_world).all()
    environment.close()


def test_path_traced_frames_repeat_to_the_last_bit():
    camera, pose, spp = from_fov(61, 33, 70.0), look_at((4, 3, 2), (0, 0, 0.5)), 23
    view = MitsubaView(mi.load_string(DOME), camera, spp)
    first = view.linear(pose, 11)[0]
    other = MitsubaView(mi.load_string(DOME), camera, spp)
    for again in (view, other) * 5:
        assert (again.linear(pose, 11)[0] == first).all()
    assert (view.linear(pose, 12)[0] != first).any()


@pytest.mark.parametrize("sky", ["noon", "evening", "overcast"])
def test_shadow_lies_opposite_to_the_sun(sky):
    scene = mi.load_string(SUN)
    set_daylight(scene, sky)
    daylight = DAYLIGHT[sky]
    camera = from_fov(64, 64, 2 * math.degrees(math.atan(0.5)))  # 20 m at 20 m
    view = MitsubaView(scene, camera, 4)
    image = view.render(look_at((0, 0, 20), (0, 0, 0)), 0).image.astype(float).mean(-1)
    x, y, z = daylight.sun_direction
    shift = np.array([-x, -y]) * 3.0 / z  # the board floats at 3 m
    column, row = (32 + 3.2 * shift * [1, -1]).astype(int)
    shadow = image[row - 1 : row + 2, column - 1 : column + 2].mean()
    lit = np.median(image)
    assert 20 < lit < 250
    if daylight.sun:
        assert abs(shift).max() > 1.1  # aside of the board, 1 m wide
        assert shadow < 0.8 * lit
    else:
        board = image[31:33, 31:33].mean()
        assert board > 20 and abs(image[2:10].mean() - lit) < 10
    set_daylight(mi.load_string(WALL), "day")  # any scene has one


@pytest.mark.parametrize("name", ["mujoco", "mujoco_gl", "carla"])
def test_packages_that_cannot_be_imported(name, tmp_path, monkeypatch):
    place, package = write_place(tmp_path), name.removesuffix("_gl")
    for loaded in list(sys.modules):
        if loaded.startswith("mi_nerfattack.deploy.mujoco"):
            monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SetupError, match=rf"{package}.* pip install .*{package}"):
        make_environment(name, place)
    if package == "mujoco":
        monkeypatch.delitem(sys.modules, "mujoco")
        (tmp_path / "mujoco.py").write_text("raise RuntimeError('invalid value')")
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setenv("MUJOCO_GL", "bogus")
        with pytest.raises(InputError, match="MUJOCO_GL=bogus .invalid value"):
            make_environment(name, place)


def step(*controls, pose=None, seed=0, begun=True):
    def drive():
        environment = blank_environment()
        if begun:
            environment.reset(a_route(), pose, seed)
        for control in controls:
            environment.step(control)

    return drive


def made(name, conditions=None, **changes):
    return lambda folder: make_environment(
        name, replace(write_place(folder), **changes), conditions or Conditions()
    )


def sky(scene, name="noon"):
    return lambda: set_daylight(mi.load_string(scene), name)


TIMED = '<scene version="3.0.0"><emitter type="sunsky"/></scene>'
BUILT, NOISY = Conditions(built_in=(object(),)), Conditions(noise_sd=0.1)
LEFT = Rig.of_one(CAMERA, CameraMount(yaw_deg=60.0), "left")
RECORDED, NONE = {"recording": Path()}, Path("none.xml")
test_refused = refusals(
    (step(0.0, begun=False), "'blank': step comes after reset"),
    (step(math.nan), "control: nan"),
    (step(pose=np.array([0.0, math.inf, 0.0])), r"pose: \[0.0, inf, 0.0\]"),
    (step(pose="north"), "pose: 'north'"),
    (step(seed=-1), "seed: -1"),
    (lambda: Conditions(spp=0), "spp: 0"),
    (lambda: Conditions(sky="night"), "sky: 'night'; one of day, morning"),
    (lambda: replace(CAMERA, width=0), "camera.width: 0"),
    (lambda: replace(CAR, max_steer=2), "car.max_steer: 2; .*1.57"),
    (lambda: replace(CAR, control_unit="deg"), "car.control_unit: 'deg'"),
    (lambda: replace(CAR, control_unit="rad"), "max_control: 1.5 rad; .* max_steer"),
    (lambda: bundled_place("moon"), "place: 'moon'; one of intersection, room"),
    (made("gazebo"), "environment: 'gazebo'; one of surrogate, "),
    (made("surrogate", field=None), "'surrogate': .*field"),
    (made("replay"), "'replay': .*recording"),
    (made("surrogate", BUILT), "'surrogate': .*built-in"),
    (made("replay", BUILT, **RECORDED), "'replay': .*built-in"),
    (made("carla", NOISY), "'carla': .*blur_px"),
    (made("carla", others=LEFT), r"'carla': .* 2 \(camera, left\)"),
    (made("replay", others=LEFT, **RECORDED), "'replay': takes one camera"),
    (made("replay", NOISY, **RECORDED), "'replay': .*blur_px"),
    (made("mitsuba", scene=NONE), "none.xml: does not exist"),
    (sky(WALL), "'noon' .*`sunsky`"),
    (sky(TIMED), "'noon': .*sun_dir"),
)


def test_a_field_is_seen_where_it_is_put(tmp_path):
    place = write_place(tmp_path)
    pose, turned = np.array([3.0, 1.0, 0.4]), Pose.upright((5.0, -2.0, 0.0), 0.7)
    moved = replace(place, field_pose=turned)
    there = [*turned.apply(np.array([[*pose[:2], 0.0]]))[0, :2], pose[2] + 0.7]
    route = load_routes(place.routes)[0]
    frames = [
        make_environment("surrogate", p).reset(route, np.array(at)).image
        for p, at in ((place, pose), (moved, there), (moved, pose))
    ]
    assert np.abs(np.int16(frames[0]) - frames[1]).max() <= 1
    assert np.abs(np.int16(frames[0]) - frames[2]).max() > 10
