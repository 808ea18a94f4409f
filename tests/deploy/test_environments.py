"""Views, vehicles and the registry that pairs them, against geometry."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from helpers.blank_view import blank_environment
from helpers.kernels import nothing_compiled
from helpers.small_fields import blob, small_ngp
from helpers.tiny_place import write_place
from scipy.ndimage import gaussian_filter

from mi_nerfattack.backend.colour import (
    linear_to_srgb_numpy,
    linear_to_uint8,
    srgb_to_linear_numpy,
)
from mi_nerfattack.deploy.car import CAR, SMALL_CAR
from mi_nerfattack.deploy.kinematic import KinematicVehicle, Motion
from mi_nerfattack.deploy.place import Conditions, bundled_place
from mi_nerfattack.deploy.registry import kinematic_vehicle, make_environment
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.deploy.views.mitsuba import MitsubaView, _parts
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import (
    CameraMount,
    from_fov,
    look_at,
)
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.pathtrace.daylight import DAYLIGHT, set_daylight
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.route.route import Route, load_routes
from mi_nerfattack.vehicle.state import to_state

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = from_fov(16, 8, 90.0)
LIGHT = 0.2
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


def axis_lengths() -> np.ndarray:
    """Return the length (8, 16) of rays to the plane one metre ahead."""
    x = (np.arange(16) + 0.5 - CAMERA.cx) / CAMERA.fx
    y = (np.arange(8) + 0.5 - CAMERA.cy) / CAMERA.fy
    return np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)


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


def test_heading_rate_turns_as_long_as_it_is_held():
    environment = blank_environment()
    environment.reset(a_route())
    for _ in range(10):
        environment.step(0.5)
    x, y, theta = environment.state
    assert theta == pytest.approx(0.5, rel=1e-3)
    assert x == pytest.approx(10 * math.sin(0.5), rel=1e-3)
    assert y == pytest.approx(10 * (1 - math.cos(0.5)), rel=2e-3)


def test_small_car_is_steered_by_an_angle():
    vehicle = kinematic_vehicle(bundled_place("room"))
    vehicle.reset(np.zeros(3), 1.0)
    for _ in range(10):
        vehicle.advance(0.1)
    assert vehicle.control_unit == "rad"
    expected = math.tan(0.1) / SMALL_CAR.wheelbase
    assert vehicle.state[2] == pytest.approx(expected, rel=1e-3)


def test_every_frame_has_a_seed_of_its_own_that_follows_from_the_drives():
    seeds = []
    for drive in (3, 3, 4):
        environment = blank_environment()
        environment.reset(a_route(), None, drive)
        for _ in range(5):
            environment.step(0.0)
        seeds.append(environment.view.seeds)
    assert seeds[0] == seeds[1]
    assert len(set(seeds[0]) | set(seeds[2])) == 12


def test_steps_refuse_what_no_vehicle_can_do():
    environment = blank_environment()
    with pytest.raises(InputError, match="'blank': step comes after reset"):
        environment.step(0.0)
    environment.reset(a_route())
    with pytest.raises(InputError, match="control: nan; a policy must return finite"):
        environment.step(math.nan)
    with pytest.raises(InputError, match=r"pose: \[0.0, inf, 0.0\]; three finite"):
        environment.reset(a_route(), np.array([0.0, math.inf, 0.0]))
    with pytest.raises(InputError, match="pose: 'north'; three finite numbers"):
        environment.reset(a_route(), "north")
    with pytest.raises(InputError, match="seed: -1; at least 0"):
        environment.reset(a_route(), None, -1)


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
    parts = ("scene", "ball", "background")
    assert set(layers) == {"", "Z", *parts, *(f"{name}.Z" for name in parts)}
    whole = sum(layers[name] for name in parts)
    assert abs(whole - layers[""]).max() < 1e-6
    assert min(layers[name][..., 3].max() for name in parts) > 0.1
    assert (linear_to_uint8(layers[""][..., :3]) == frame.image).mean() > 0.99


@pytest.mark.parametrize("name", ["surrogate", "mitsuba"])
def test_only_posed_fields_are_shown(name, tmp_path):
    environment = make_environment(name, write_place(tmp_path), Conditions(spp=1))
    field = blob(np.random.default_rng(0))
    with pytest.raises(InputError, match="objects: GridField; only posed fields can"):
        environment.show([field])
    assert environment.reset(a_route()).image.any()  # shows what it showed before


@pytest.mark.parametrize("exposure_ev", [0.0, 1.0, -2.0])
def test_wall_of_known_radiance_at_known_distance(exposure_ev):
    view = MitsubaView(mi.load_string(WALL), CAMERA, 4, exposure_ev)
    frame = view.render(look_at((0, 0, 0), (1, 0, 0)), 3)
    linear = LIGHT * 2.0**exposure_ev
    level = round(255 * (1.055 * linear ** (1 / 2.4) - 0.055))
    lengths = 5 * axis_lengths()
    x = (np.arange(16) + 0.5 - 8) / 8 * 5  # metres on the wall, which is 4 m wide
    y = (np.arange(8) + 0.5 - 4) / 8 * 5
    on_wall = (abs(x)[None] < 2) & (abs(y)[:, None] < 2)
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
    assert unclipped.size > 200
    assert unclipped.std() == pytest.approx(0.05, rel=0.15)
    assert abs(unclipped.mean()) < 0.01
    assert (frame.depth == clear.depth).all()
    assert (environment.reset(a_route(), None, 5).image == frame.image).all()
    assert (environment.reset(a_route(), None, 6).image != frame.image).any()


def test_any_number_of_samples_is_split_into_powers_of_two():
    for spp in range(1, 70):
        parts = _parts(spp)
        assert sum(parts) == spp
        assert set(parts) <= {16, 8, 4, 2, 1}


def test_path_traced_frames_repeat_to_the_last_bit():
    camera, pose, spp = from_fov(61, 33, 70.0), look_at((4, 3, 2), (0, 0, 0.5)), 20
    view = MitsubaView(mi.load_string(DOME), camera, spp)
    first = view.linear(pose, 11)[0]
    other = MitsubaView(mi.load_string(DOME), camera, spp)
    for _ in range(5):
        assert (view.linear(pose, 11)[0] == first).all()
        assert (other.linear(pose, 11)[0] == first).all()
    assert (view.linear(pose, 12)[0] != first).any()


@pytest.mark.parametrize("name", ["surrogate", "mitsuba"])
def test_no_kernel_is_compiled_after_the_first_step(name, tmp_path):
    environment = make_environment(name, write_place(tmp_path), Conditions(spp=4))
    environment.reset(a_route(), None, 0)
    environment.show([PosedField(blob(np.random.default_rng(0)))])
    environment.step(0.1)
    with nothing_compiled():
        for control in (-0.3, 0.2):
            frame = environment.step(control)
    assert frame.image.max() > 20
    environment.close()


@pytest.mark.parametrize("name", ["surrogate", "mitsuba"])
def test_a_period_without_a_look_leads_to_the_same_frame(name, tmp_path):
    conditions = Conditions(spp=2, noise_sd=0.05)
    environment = make_environment(name, write_place(tmp_path), conditions)
    environment.reset(a_route(), None, 3)
    for control in (0.4, -0.2, 0.3):
        seen = environment.step(control)
    environment.reset(a_route(), None, 3)
    environment.advance(0.4)
    environment.advance(-0.2)
    frame = environment.step(0.3)
    assert (frame.image == seen.image).all()
    assert (frame.camera_to_world == seen.camera_to_world).all()
    environment.close()


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


def test_scene_without_a_sun_has_one_time_of_day():
    scene = mi.load_string(WALL)
    set_daylight(scene, "day")
    with pytest.raises(InputError, match="'noon' needs a scene with a `sunsky`"):
        set_daylight(scene, "noon")
    timed = mi.load_string('<scene version="3.0.0"><emitter type="sunsky"/></scene>')
    with pytest.raises(InputError, match="'noon': the sun of .* give it a sun_dir"):
        set_daylight(timed, "noon")


def test_conditions_and_place_are_checked(tmp_path):
    place = write_place(tmp_path)
    for whole, change, message in (
        (Conditions(), {"spp": 0}, "spp: 0; must be a whole number of at least 1"),
        (Conditions(), {"spp": 2.5}, "spp: 2.5; must be a whole number of at least 1"),
        (Conditions(), {"exposure_ev": math.inf}, "exposure_ev: inf; must be a finite"),
        (Conditions(), {"sky": "night"}, "sky: 'night'; one of day, morning"),
        (place, {"period": 0}, "place.period: 0; must be .* above 0, seconds"),
        (place.camera, {"width": 0}, "camera.width: 0; must be positive"),
        (CAR, {"max_steer": 2}, r"car.max_steer: 2; .* in \(0, 1.57.*, radians"),
        (CAR, {"control_unit": "deg"}, "car.control_unit: 'deg'"),
        (CAR, {"control_unit": "rad"}, "max_control: 1.5 rad; .* max_steer, 0.75"),
    ):
        with pytest.raises(InputError, match=message):
            replace(whole, **change)


def test_environments_that_cannot_be_made(tmp_path, monkeypatch):
    place = write_place(tmp_path)
    with pytest.raises(InputError, match="environment: 'gazebo'; one of surrogate, "):
        make_environment("gazebo", place)
    with pytest.raises(InputError, match="'surrogate': the place has no field"):
        make_environment("surrogate", replace(place, field=None))
    with pytest.raises(InputError, match="'replay': the place has no recording"):
        make_environment("replay", place)
    for name in ("surrogate", "replay"):
        built_in = Conditions(built_in=(object(),))
        with pytest.raises(InputError, match=f"'{name}': takes no built-in objects"):
            make_environment(name, replace(place, recording=tmp_path), built_in)
    for name in ("carla", "replay"):
        with pytest.raises(InputError, match=f"'{name}': takes no blur_px and no"):
            noisy = Conditions(noise_sd=0.1)
            make_environment(name, replace(place, recording=tmp_path), noisy)
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(InputError, match=r"'carla': its client .*pip .*\[carla\]'"):
        make_environment("carla", place)
    missing = replace(place, scene=tmp_path / "none.xml")
    with pytest.raises(InputError, match=r"none.xml: does not exist"):
        make_environment("mitsuba", missing)


@pytest.mark.parametrize("name", ["mujoco", "mujoco_gl"])
def test_mujoco_that_cannot_be_imported(name, tmp_path, monkeypatch):
    place = write_place(tmp_path)
    for loaded in list(sys.modules):
        if loaded.startswith("mi_nerfattack.deploy.mujoco"):
            monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match="mujoco is not installed; pip install mujoco"):
        make_environment(name, place)
    monkeypatch.delitem(sys.modules, "mujoco")
    (tmp_path / "mujoco.py").write_text("raise RuntimeError('invalid value')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MUJOCO_GL", "bogus")
    with pytest.raises(InputError, match="MUJOCO_GL=bogus .invalid value.; unset it"):
        make_environment(name, place)


def test_bundled_places():
    crossing, room = bundled_place(), bundled_place("room")
    assert crossing.car == CAR and crossing.field is not None
    assert room.car.control_unit == "rad"
    for place in (crossing, room):
        assert place.scene.is_file()
        assert load_routes(place.routes)
    with pytest.raises(InputError, match="place: 'moon'; one of intersection, room"):
        bundled_place("moon")


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
