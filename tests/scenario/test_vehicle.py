"""The section ``[vehicle]``: its models, and functions of the user's own."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.scenario_text import HEAD, write_named_files
from helpers.states import row64, state64

from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.scenario import load_scenario, portable_text
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.vehicle import VehicleSection
from mi_nerfattack.vehicle import (
    RK4,
    Ackermann,
    Dubins,
    KinematicBicycle,
    RateLimitedAckermann,
)

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
    return vehicle(folder, model="custom", function=name, **values).build()


def test_models_of_the_section():
    default = vehicle()
    assert default.build() == Dubins(5.0, 1.5)
    assert default.substeps == 1 and default.delay_steps == 0
    assert default.motion().integrator == RK4()
    degree = np.pi / 180

    def build(model, **keys):
        return vehicle(model=model, speed_ms=4.0, **keys).build()

    assert build("ackermann", wheelbase_m=2.0) == Ackermann(4.0, 2.0, 34 * degree)
    assert build(
        "ackermann_rate", max_steer_rate_deg_s=30.0, steer_time_s=0.2
    ) == RateLimitedAckermann(4.0, 2.7, 34 * degree, 30 * degree, 0.2)
    assert build(
        "bicycle", front_axle_m=1.0, rear_axle_m=1.5, max_steer_deg=20.0
    ) == KinematicBicycle(4.0, 1.0, 1.5, 20 * degree)


@pytest.mark.parametrize(
    ("name", "framework"), [("car", "drjit"), ("torch_car", "torch")]
)
def test_function_of_a_file(folder, name, framework):
    dynamics = custom(folder, f"car.py:{name}", framework)
    np.testing.assert_array_equal(dynamics.extend(np.zeros(3)), [[0, 0, 0, 5]])
    slope = dynamics.derivative(state64([[0], [0], [0], [6]]), row64([0.5]))
    np.testing.assert_allclose(slope.numpy()[:, 0], [6, 0, 0.5, 2])
    assert float(dynamics.saturate(row64([100.0]))[0]) == pytest.approx(1.5)


def test_function_without_the_word_of_trust(folder):
    with pytest.raises(InputError, match="vehicle.function: car.py.*trust_code = true"):
        custom(folder, "car.py:car", trust=False)


def test_function_of_a_module(folder, monkeypatch):
    (folder / "own_cars.py").write_text(FILE)
    monkeypatch.syspath_prepend(str(folder))
    assert custom(folder, "own_cars:car").state_size == 4


@pytest.mark.parametrize(
    ("name", "framework", "words"),
    [
        ("gone.py:car", "drjit", r"gone.py: does not exist"),
        ("car.py:cart", "drjit", r"car.py: has no function 'cart'; it has car, "),
        ("car.py:number", "drjit", r"has no function 'number'"),
        ("no_such_package.cars:car", "drjit", r"No module named 'no_such_package'.*F"),
        ("math:cart", "drjit", r"math has no function 'cart'"),
        ("broken:car", "drjit", r"importing it raised ZeroDivisionError"),
        ("broken.py:car", "drjit", r"broken.py: raised ZeroDivisionError"),
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
    (folder / "broken.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(str(folder))
    with pytest.raises(InputError, match=words):
        custom(folder, name, framework)


HEAD_ONNX = HEAD.replace("policy.safetensors", "policy.onnx")  # of any vehicle
SCENARIO = f"""\
{HEAD_ONNX}[vehicle]
model = "custom"
function = "car.py:car"
control_limit = 1.5
state_size = 4
rest_state = [5.0]
"""


def load(folder, text):
    path = folder / "scenario.toml"
    path.write_text(text)
    return load_scenario(path)[0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"custom"', '"dubins"', r":15: vehicle.function: has no meaning with model"),
        ('function = "car.py:car"\n', "", r"vehicle.function: is missing; model"),
        ("= 1.5", "= 1.5\nmax_steer_rate_deg_s = 40.0", r":17: .*has no meaning with"),
        ("control_limit = 1.5\n", "", r"vehicle.control_limit: is missing"),
        (
            "car.py:car",
            "car.py",
            r":15: vehicle.function: must have the form FILE.py:NAME",
        ),
        ("= 1.5", "= -1.5", r":16: vehicle.control_limit: "),
        ("= 4", "= 2", r":17: vehicle.state_size: .*greater than or equal to 3"),
        ("= 4", "= 5", r":18: vehicle.rest_state: has 1 numbers; .* needs 2 or none"),
        ("[5.0]", "[5.0]\nsubsteps = 0", r":19: vehicle.substeps: "),
        ("[5.0]", "[5.0]\ndelay_steps = -1", r":19: vehicle.delay_steps: "),
        (
            SCENARIO[SCENARIO.index("model") :],
            'model = "ackermann_rate"\nsteer_time_s = 0.03\n',
            r":15: vehicle.steer_time_s: .* diverge with rk4: .* raise substeps",
        ),
    ],
)
def test_section_is_checked(folder, old, new, words):
    assert load(folder, SCENARIO).vehicle.rest_state == (5.0,)
    with pytest.raises(InputError, match=words):
        load(folder, SCENARIO.replace(old, new))


def test_stiff_steering_is_taken_with_enough_substeps(folder):
    head = SCENARIO[: SCENARIO.index("model")]
    text = head + 'model = "ackermann_rate"\nsteer_time_s = 0.03\nsubsteps = 2\n'
    assert load(folder, text).vehicle.substeps == 2


def test_digest_and_text_follow_the_function(folder):
    write_named_files(folder)
    (folder / "policy.onnx").write_text("policy")
    first = load(folder, SCENARIO).digest()
    text = portable_text(load(folder, SCENARIO), SCENARIO)
    assert str(folder / "car.py:car") in text
    assert load(folder, text).digest() == first
    (folder / "car.py").write_text(FILE + "# changed\n")
    assert load(folder, SCENARIO).digest() != first
    module = SCENARIO.replace("car.py:car", "own.cars:car")
    assert portable_text(load(folder, module), module).count('"own.cars:car"') == 1
    assert load(folder, module).digest() != first
