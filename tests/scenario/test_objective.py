"""The objective in a scenario file: defaults, refusals with lines, files it names."""

from __future__ import annotations

import json
import re
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from helpers.scenario_text import HEAD, write_named_files

from mi_nerfattack.attack.objectives import (
    AbsoluteDeviation,
    CrossTrackDeviation,
    DepartureTime,
    HeadingDeviation,
    TargetDistance,
)
from mi_nerfattack.attack.user_cost import UserCost
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.objective import (
    StageSum,
    StateHistory,
    Terminal,
    WeightedSum,
)
from mi_nerfattack.rollout.reduction import CVaR, Mean, Worst
from mi_nerfattack.scenario.scenario import load_scenario, portable_text
from mi_nerfattack.vehicle import Dubins, Route

pytestmark = pytest.mark.usefixtures("variant")

FUNCTION = '[objective]\nkind = "function"\ntrust_code = true\nfunction = '
ROUTE = Route("lane", 0, np.array([[0, 0], [10, 0], [20, 5]], np.float64))
COST = """\
from __future__ import annotations
from dataclasses import dataclass
import drjit as dr
import numpy as np

def squared(state):
    return dr.square(state[1]) - state[0]

@dataclass
class Slope:
    gain: float = 2.0
    def __call__(self, state):
        return self.gain * state[2]

slope = Slope()
def to_numpy(state):
    return np.square(state[1].numpy())
def detached(state):
    return dr.detach(state[1])
def summed(state):
    return dr.sum(state[1])
def mixed(state):
    return state[0] * dr.sum(state[1])
def infinite(state):
    return state[0] / 0
def kinked(state):
    return dr.sqrt(state[0] - dr.detach(state[0]))
number = 3
"""


@pytest.fixture
def write(tmp_path):
    """Write a scenario with an [objective] and the files that it may name."""
    (tmp_path / "costs.py").write_text(COST)
    (tmp_path / "broken.py").write_text("x = 1\ndef f(:\n")
    (tmp_path / "raises.py").write_text("1 / 0\n")
    entry = {"goal": 0, "lane_width_m": 3.0, "speed_ms": 5.0}
    entry["points_m"] = [[0, 3], [20, 3]]
    (tmp_path / "targets.json").write_text(json.dumps({"verge": entry}))
    write_named_files(tmp_path)

    def inner(text):
        path = tmp_path / "scenario.toml"
        path.write_text(HEAD + "[drive]\nhorizon = 4\n" + text)
        return path

    return inner


def build(path):
    scenario, _ = load_scenario(path)
    return scenario.objective.build(scenario, ROUTE, Dubins())


def test_default_is_the_summed_distance(write):
    objective = build(write(""))
    assert isinstance(objective, StageSum) and objective.weights is None
    assert objective.cost == CrossTrackDeviation(ROUTE, 0.05)
    scenario, _ = load_scenario(write(""))
    assert isinstance(scenario.objective.reduction.build(), Mean)


@pytest.mark.parametrize(
    ("text", "cost"),
    [
        ('kind = "cross_track"\nrounding_m = 0.2', CrossTrackDeviation(ROUTE, 0.2)),
        ('kind = "absolute_cross_track"', AbsoluteDeviation(ROUTE)),
        (
            'kind = "heading"\nrounding_deg = 2.0',
            HeadingDeviation(ROUTE, float(np.radians(2.0))),
        ),
    ],
)
def test_kinds(write, text, cost):
    objective = build(write(f"[objective]\n{text}\n"))
    assert isinstance(objective, StageSum) and objective.cost == cost
    objective = build(write(f'[objective]\n{text}\nat = "end"\n'))
    assert isinstance(objective, Terminal) and objective.cost == cost


def test_departure_time(write):
    objective = build(write('[objective]\nkind = "departure_time"\n'))
    assert isinstance(objective, DepartureTime)
    assert objective.limit_m == pytest.approx(3.5 / 2 - 1.8 / 2)
    objective = build(
        write('[objective]\nkind = "departure_time"\nlimit_m = 1.5\nsoftness_m = 0.1\n')
    )
    assert (objective.limit_m, objective.softness_m) == (1.5, 0.1)


def test_target_path(write):
    text = 'kind = "target_path"\ntarget = "targets.json"\ntarget_route = "verge"'
    objective = build(write(f"[objective]\n{text}\n"))
    assert isinstance(objective.cost, TargetDistance)
    assert objective.cost.path.points.tolist() == [[0, 3], [20, 3]]


@pytest.mark.parametrize(
    ("text", "weights"),
    [
        ('weights = "linear"', [0.25, 0.5, 0.75, 1]),
        ('weights = "last"\nlast_s = 0.2', [0, 0, 1, 1]),
        ('weights = "discount"\ndiscount_per_s = 0.5', 0.5 ** (np.arange(4) / 10)),
        ('weights = "listed"\nlisted_weights = [0.0, 1.0, -1.0, 2.0]', [0, 1, -1, 2]),
    ],
)
def test_weights(write, text, weights):
    objective = build(write(f"[objective]\n{text}\n"))
    np.testing.assert_allclose(objective.weights, weights, rtol=1e-15)


def test_further_terms_and_reductions(write):
    text = """\
[objective]
weight = 0.5
reduction = "cvar"
cvar_fraction = 0.4
[[objective.terms]]
kind = "departure_time"
weight = 3.0
[[objective.terms]]
kind = "heading"
at = "end"
"""
    path = write(text)
    objective = build(path)
    assert isinstance(objective, WeightedSum)
    assert [weight for weight, _ in objective.terms] == [0.5, 3.0, 1.0]
    kinds = [type(term) for _, term in objective.terms]
    assert kinds == [StageSum, DepartureTime, Terminal]
    scenario, _ = load_scenario(path)
    assert scenario.objective.reduction.build() == CVaR(0.4)
    again = type(scenario).model_validate_json(
        scenario.model_dump_json(), context={"folder": path.parent}
    )
    assert again == scenario
    worst, _ = load_scenario(write('[objective]\nreduction = "worst"\n'))
    assert isinstance(worst.objective.reduction.build(), Worst)


def test_function_of_the_user(write):
    objective = build(write(f'{FUNCTION}"costs.py:squared"'))
    assert isinstance(objective.cost, UserCost)
    rows = dr.llvm.ad.Array3f64([[1, 2, 3, 4], [0, 1, 0, 2], [0] * 4])
    dr.enable_grad(rows)
    value = objective.evaluate(StateHistory(rows, 1, 4, 0.1))
    assert value.numpy() == pytest.approx([-5.0])
    dr.backward(value)
    np.testing.assert_allclose(dr.grad(rows).numpy()[1], [0, 2, 0, 4])
    slope = build(write(f'{FUNCTION}"costs.py:slope"'))
    assert slope.cost(rows).numpy().tolist() == [0] * 4
    path = write(f'{FUNCTION}"costs.py:slope"'.replace("true", "false"))
    with pytest.raises(InputError, match="objective.function: costs.*trust_code = "):
        build(path)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        ("absent.py:f", ["absent.py", "does not exist"]),
        ("costs.py:absent", ["costs.py", "no function 'absent'", "squared"]),
        ("costs.py:number", ["costs.py", "no function 'number'"]),
        ("broken.py:f", ["broken.py:2"]),
        ("raises.py:f", ["raises.py", "ZeroDivisionError"]),
        ("costs.py:to_numpy", ["costs.py:to_numpy", "ndarray", "Dr.Jit"]),
        ("costs.py:detached", ["costs.py:detached", "no derivative"]),
        ("costs.py:summed", ["costs.py:summed", "1 numbers for 2 states"]),
        ("costs.py:mixed", ["costs.py:mixed", "depends on another"]),
        ("costs.py:infinite", ["costs.py:infinite", "not finite at states"]),
        ("costs.py:kinked", ["costs.py:kinked", "derivative is not finite"]),
    ],
)
def test_unusable_functions_are_named(write, function, words):
    path = write(f'{FUNCTION}"{function}"')
    with pytest.raises(InputError) as caught:
        build(path)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ('kind = "lateral"', 16, ["objective.kind", "cross_track", "lateral"]),
        ('knd = "heading"', 16, ["objective.knd", "unknown", "softness_m"]),
        ('kind = "target_path"', 15, ["objective.target:", "missing", "target_path"]),
        (
            'kind = "target_path"\ntarget = "t.json"',
            15,
            ["objective.target_route:", "missing"],
        ),
        ('target = "t.json"', 16, ["objective.target:", 'kind = "cross_track"']),
        ('kind = "function"', 15, ["objective.function:", "missing"]),
        ('kind = "function"\nfunction = "f.txt:g"', 17, ["function", "f.txt:g"]),
        ("softness_m = 0.1", 16, ["softness_m", 'set kind to "departure_time"']),
        ('kind = "departure_time"\nat = "end"', 17, ["objective.at:", "no meaning"]),
        (
            'kind = "departure_time"\nweights = "linear"',
            17,
            ["objective.weights:", "no meaning"],
        ),
        ('at = "end"\nweights = "linear"', 17, ["weights", 'at = "end"']),
        ('weights = "last"', 15, ["last_s", "missing"]),
        ("last_s = 2.0", 16, ["last_s", "no meaning", '"last"']),
        ('weights = "listed"\nlisted_weights = [1.0, nan]', 17, ["listed_weights.1"]),
        ("cvar_fraction = 0.5", 16, ["cvar_fraction", 'reduction to "cvar"']),
        ('reduction = "cvar"', 15, ["cvar_fraction", "missing"]),
        (
            '[[objective.terms]]\n[[objective.terms]]\nkind = "x"',
            18,
            ["objective.terms.1.kind"],
        ),
        (
            "[[objective.terms]]\nweight = 2.0\n[[objective.terms]]\nlast_s = 0.5",
            19,
            ["objective.terms.1.last_s"],
        ),
        (
            '[[objective.terms]]\n[[objective.terms]]\nkind = "function"',
            17,
            ["objective.terms.1.function", "missing"],
        ),
        ('[[objective.terms]]\nreduction = "mean"', 17, ["terms.0.reduction", "kind"]),
    ],
)
def test_refusals_name_key_line_and_remedy(write, text, line, words):
    path = write(f"[objective]\n{text}\n")
    with pytest.raises(InputError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert f"{path}:{line}:" in message
    for word in words:
        assert word in message


def test_weights_that_do_not_fit_the_horizon(write):
    path = write('[objective]\nweights = "listed"\nlisted_weights = [1.0, 2.0]\n')
    with pytest.raises(InputError, match="2 numbers for a horizon of 4"):
        build(path)
    with pytest.raises(InputError, match=r"last_s: 9\.0 s is 90 control periods"):
        build(write('[objective]\nweights = "last"\nlast_s = 9.0\n'))


def test_missing_target_is_named(write):
    text = 'kind = "target_path"\ntarget = "absent.json"\ntarget_route = "verge"'
    with pytest.raises(InputError, match="absent.json"):
        build(write(f"[objective]\n{text}\n"))


def test_digest_and_text_follow_the_files(write, tmp_path):
    text = """\
[objective]
kind = "function"
function = "costs.py:squared"
trust_code = true
[[objective.terms]]
kind = "target_path"
target = "targets.json"
target_route = "verge"
"""
    path = write(text)

    def digest(file=path):
        scenario, _ = load_scenario(file)
        return scenario.digest()

    first = digest()
    elsewhere = tmp_path / "elsewhere" / "scenario.toml"
    elsewhere.parent.mkdir()
    elsewhere.write_text(portable_text(*load_scenario(path)))
    assert digest(elsewhere) == first
    scenario, _ = load_scenario(elsewhere)
    assert scenario.objective.build(scenario, ROUTE, Dubins())
    (tmp_path / "costs.py").write_text(COST + "\n")
    second = digest()
    assert second != first
    (tmp_path / "targets.json").write_text("{}")
    assert digest() not in (first, second)
    write(text.replace("squared", "slope"))
    assert digest() not in (first, second)


def test_examples_of_the_manual(write, tmp_path):
    """The scenario and the function in docs/attack.md work as they are written."""
    manual = (Path(__file__).parents[2] / "docs" / "attack.md").read_text("utf-8")
    section = manual[manual.index("## The objective") :]
    [toml] = re.findall(r"```toml\n(.*?)```", section, re.S)[:1]
    objective = build(write(toml))
    assert [weight for weight, _ in objective.terms] == [1.0, 0.1]
    blocks = re.findall(r"```python\n(.*?)```", section, re.S)
    (tmp_path / "manual.py").write_text(blocks[0])
    objective = build(write(f'{FUNCTION}"manual.py:leave_to_the_right"'))
    state = dr.llvm.ad.Array3f64([0, 0], [1, -7], [0, 0])
    assert objective.cost(state).numpy().tolist() == [7, 0]
    names = {"route": ROUTE, "weights": np.ones(4)}
    exec(blocks[1], names)
    assert len(names["objective"].terms) == 2
