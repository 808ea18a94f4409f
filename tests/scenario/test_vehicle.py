"""The section ``[vehicle]``: its models, and functions of the user's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.reference.derivatives import row64, state64

from mi_nerfattack import vehicle as models
from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.vehicle import VehicleSection
from mi_nerfattack.vehicle.dynamics import to_control, to_state
from mi_nerfattack.vehicle.integrators import Transition

pytestmark = pytest.mark.usefixtures("variant")

FILE = """
import drjit as dr
import torch

def car(state, control):
    _, _, theta, speed = state
    return speed * dr.cos(theta), speed * dr.sin(theta), control, 8 - speed

def torch_car(state, control):
    _, _, theta, speed = state.unbind(1)
    rows = speed * theta.cos(), speed * theta.sin(), control, 8 - speed
    return torch.stack(rows, 1)

def constant(state, control):
    return state[0], state[1], control, 8 - dr.detach(state[3])

def torch_constant(state, control):
    return torch.cat([state[:, :2], control[:, None], -state[:, 3:].detach()], 1)

def mean(state, control):
    return state[0], state[1], control, dr.mean(state[3])

def root(state, control):
    return state[0], state[1], control, dr.sqrt(state[3] - 9)

def steep(state, control):
    return torch.cat([state[:, :2], control[:, None], (0 * state[:, 3:]).sqrt()], 1)

def fails(state, control):
    raise KeyError("wheel")

def two(state, control):
    _, _, theta, speed = state
    turn, force = control
    return speed * dr.cos(theta), speed * dr.sin(theta), turn, force - speed

def half(state, control):
    _, _, theta, speed = state
    turn, force = control
    return speed * dr.cos(theta), speed * dr.sin(theta), turn, dr.detach(force) - speed

number = 3
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "car.py").write_text(FILE)
    return tmp_path


def vehicle(folder=".", **keys):
    return read_section("vehicle", VehicleSection, keys, folder)


def custom(folder, name, framework="drjit", trust=True):
    values = {"state_size": 4, "control_limit": 1.5, "rest_state": (5.0,)}
    values |= {"framework": framework, "trust_code": trust}
    return vehicle(folder, kind="custom", function=name, **values).build()


def test_models_of_the_section():
    default = vehicle()
    assert default.build() == models.Dubins(5.0, 1.5)
    assert default.substeps == 1 and default.delay_steps == 0
    assert default.motion().integrator == models.RK4()
    degree = np.pi / 180

    def build(kind, **keys):
        return vehicle(kind=kind, speed_ms=4.0, **keys).build()

    assert build("ackermann", wheelbase_m=2.0) == models.Ackermann(
        4.0, 2.0, 34 * degree
    )
    assert build(
        "ackermann_rate", max_steer_rate_deg_s=30.0, steer_time_s=0.2
    ) == models.RateLimitedAckermann(4.0, 2.7, 34 * degree, 30 * degree, 0.2)
    assert build(
        "bicycle", front_axle_m=1.0, rear_axle_m=1.5, max_steer_deg=20.0
    ) == models.KinematicBicycle(4.0, 1.0, 1.5, 20 * degree)


def test_wheels_stand_where_the_models_point_says():
    for kind in ("bicycle", "dynamic_single_track"):
        car = vehicle(kind=kind, front_axle_m=1.0, rear_axle_m=1.5).car()
        assert (car.wheelbase, car.reference) == (2.5, 1.5)
    for kind in ("dubins", "ackermann", "kinematic_single_track"):
        assert vehicle(kind=kind).car().reference == 0


@pytest.mark.parametrize(
    ("name", "framework"),
    [("car.py:car", "drjit"), ("car.py:torch_car", "torch"), ("own_cars:car", "drjit")],
)
def test_function_of_the_user(folder, monkeypatch, name, framework):
    (folder / "own_cars.py").write_text(FILE)
    monkeypatch.syspath_prepend(str(folder))
    dynamics = custom(folder, name, framework)
    assert dynamics.state_size == 4
    np.testing.assert_array_equal(dynamics.extend(np.zeros(3)), [[0, 0, 0, 5]])
    slope = dynamics.derivative(state64([[0], [0], [0], [6]]), row64([0.5]))
    np.testing.assert_allclose(slope.numpy()[:, 0], [6, 0, 0.5, 2])
    assert float(dynamics.saturate(row64([100.0]))[0]) == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("name", "framework", "words"),
    [
        ("gone.py:car", "drjit", r"gone.py: does not exist"),
        ("car.py:cart", "drjit", r"car.py: has no function 'cart'; it has car, "),
        ("car.py:number", "drjit", r"has no function 'number'"),
        ("broken.py:f", "drjit", r"broken.py:2: "),
        ("no_such_package.cars:car", "drjit", r"No module named 'no_such_package'.*F"),
        ("math:cart", "drjit", r"math has no function 'cart'"),
        ("raises:car", "drjit", r"importing it raised ZeroDivisionError"),
        ("raises.py:car", "drjit", r"raises.py: raised ZeroDivisionError"),
        ("car.py:fails", "drjit", r"car.py:fails\): raised KeyError in line 30"),
        ("car.py:torch_car", "drjit", r"torch_car\): raised AttributeError"),
        ("car.py:car", "torch", r"car\): raised ValueError"),
        ("car.py:constant", "drjit", r"row 3 .* no derivative by row 3 of the state"),
        ("car.py:torch_constant", "torch", r"row 3 .* no derivative by row 3"),
        ("car.py:mean", "drjit", r"vehicles must not mix"),
        ("car.py:root", "drjit", r"gave .*nan"),
        ("car.py:steep", "torch", r"derivative by row 3 of the state is .*nan"),
    ],
)
def test_functions_that_are_refused(folder, monkeypatch, name, framework, words):
    (folder / "broken.py").write_text("x = 1\ndef f(:\n")
    (folder / "raises.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(str(folder))
    with pytest.raises(InputError, match=words):
        custom(folder, name, framework)


def test_a_function_without_the_word_of_trust_is_refused(folder):
    with pytest.raises(InputError, match="vehicle.function: car.py.*trust_code = true"):
        custom(folder, "car.py:car", trust=False)


@pytest.mark.parametrize(
    "keys",
    [{}, {"speed_ms": 15.0}, {"steer_time_s": 0.03}, {"max_steer_rate_deg_s": 200.0}],
)
def test_hard_steering_with_a_lag_stays_within_a_centimetre(keys):
    """Full lock to both sides for 6 s, against float64 with errors below 1e-9."""
    section = vehicle(kind="ackermann_rate", **keys)
    motion = section.motion()
    car = motion.dynamics
    state = to_state(np.zeros((1, 4)))
    step = Transition(car, motion.integrator, section.dt_s, motion.substeps)
    exact, worst = np.zeros(4), 0.0
    limit = car.max_steer / 2**0.125  # of a command of full lock

    def slope(_, x):
        rate = (command - x[3]) / car.time_constant / car.max_steer_rate
        rate *= car.max_steer_rate / (1 + rate**8) ** 0.125
        heading = car.speed / car.wheelbase * np.tan(x[3])
        along = car.speed * np.array([np.cos(x[2]), np.sin(x[2])])
        return [*along, heading, rate]

    for period in range(60):
        sign = 1 if period // 10 % 2 == 0 else -1
        command = sign * limit
        exact = solve_ivp(slope, (0, 0.1), exact, rtol=1e-11, atol=1e-11).y[:, -1]
        control = to_state(np.full((1, 3), sign * car.max_steer))[0]
        state = step.advance(state, control, control)
        worst = max(worst, float(np.abs(state.numpy()[:2, 0] - exact[:2]).max()))
    assert worst < 0.01
    stiff = vehicle(kind="ackermann_rate", steer_time_s=0.03, substeps=2)
    assert stiff.substeps == 2 and vehicle().substeps == 1


def test_models_with_a_speed_state():
    section = vehicle(kind="kinematic_single_track", speed_ms=7.0, max_brake_ms2=6.0)
    steer = np.radians(34.0)
    model = models.KinematicSingleTrack(7.0, steer, 3.0, 6.0, 0.5, 2.7)
    assert section.build() == model and section.has_expert and section.unit == "rad"
    (acceleration,) = section.car().more_controls
    assert (acceleration.lowest, acceleration.highest) == (-6.0, 3.0)
    slips = vehicle(kind="dynamic_single_track", mass_kg=1000.0, friction=0.5)
    car, built = slips.car(), slips.build()
    assert (built.mass, built.friction, car.mass, car.wheelbase) == (1e3, 0.5, 1e3, 2.7)
    # steps are so fine that a car that brakes hard in a bend comes to rest
    assert slips.dt_s / slips.substeps <= 2 / built.fastest_rate
    assert vehicle(kind="kinematic_single_track").substeps == 1
    with pytest.raises(InputError, match="vehicle.substeps: .*diverge.*raise substeps"):
        vehicle(kind="dynamic_single_track", substeps=2)


def test_custom_vehicles_with_several_controls(folder):
    keys = {"kind": "custom", "function": "car.py:two", "trust_code": True}
    keys |= {"state_size": 4, "rest_state": (5.0,), "controls": 2}
    section = vehicle(folder, **keys, control_limit=(1.5, 3.0), control_unit="rad/s")
    dynamics = section.build()
    assert dynamics.control_size == 2 and not section.has_expert
    limited = dynamics.saturate(to_control(np.full((1, 2), 100.0)))
    np.testing.assert_allclose(limited.numpy()[:, 0], [1.5, 3.0])
    both = vehicle(folder, **keys, control_limit=2.0).build()
    assert (
        both.saturate(to_control(np.full((1, 2), -9.0))).numpy().tolist()
        == [[pytest.approx(-2.0, rel=1e-4)]] * 2
    )
    for changes, words in (
        ({"control_limit": (1.0, 2.0, 3.0)}, "control_limit: has 3 numbers"),
        ({"control_limit": (1.0, -2.0)}, "control_limit.1: .*greater than 0"),
        ({"control_limit": -1.0}, "control_limit: .*greater than 0"),
        ({"function": "car.py:half"}, "no derivative by the control"),
    ):
        with pytest.raises(InputError, match=words):
            vehicle(folder, **({**keys, "control_limit": 1.0} | changes)).build()


def test_the_number_of_controls_leaves_old_digests_alone(folder):
    keys = {"kind": "custom", "function": "car.py:car", "control_limit": 1.5}
    assert ("controls",) not in [way for way, _ in vehicle(folder, **keys).leaves()]
    several = vehicle(folder, **keys, controls=2)
    assert (("controls",), 2) in list(several.leaves())
