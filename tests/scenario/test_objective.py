"""The objective in a scenario file: what is built of it, and what cannot be."""

from __future__ import annotations

import json
import re
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from support.files.runs import HEAD, write_named_files

from mi_nerfattack.attack import objectives
from mi_nerfattack.attack.user_cost import UserCost
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.objective import (
    CVaR,
    Mean,
    StageSum,
    StateHistory,
    Terminal,
    WeightedSum,
    Worst,
)
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.vehicle import Dubins, Route

pytestmark = pytest.mark.usefixtures("variant")

TERM = "[[objective.term]]\n"
FUNCTION = f'{TERM}kind = "function"\ntrust_code = true\nfunction = '
ROUTE = Route("lane", 0, np.array([[0, 0], [10, 0], [20, 5]], np.float64))
TARGET = f'{TERM}kind = "target_path"\ntarget_route = "verge"\ntarget = '
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
to_numpy = lambda state: np.square(state[1].numpy())
detached = lambda state: dr.detach(state[1])
summed = lambda state: dr.sum(state[1])
mixed = lambda state: state[0] * dr.sum(state[1])
infinite = lambda state: state[0] / 0
kinked = lambda state: dr.sqrt(state[0] - dr.detach(state[0]))
"""


@pytest.fixture
def write(tmp_path):
    """Write a scenario with an [objective] and the files that it may name."""
    (tmp_path / "costs.py").write_text(COST)
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


@pytest.mark.parametrize(
    ("text", "cost"),
    [
        ("", objectives.CrossTrackDeviation(ROUTE, 0.05)),
        (
            'kind = "cross_track"\nrounding_m = 0.2',
            objectives.CrossTrackDeviation(ROUTE, 0.2),
        ),
        ('kind = "absolute_cross_track"', objectives.AbsoluteDeviation(ROUTE)),
        (
            'kind = "heading"\nrounding_deg = 2.0',
            objectives.HeadingDeviation(ROUTE, float(np.radians(2.0))),
        ),
    ],
)
def test_kinds(write, text, cost):
    path = write(f"{TERM}{text}\n" if text else "")
    objective = build(path)
    assert isinstance(objective, StageSum) and objective.cost == cost
    assert objective.weights is None
    assert isinstance(load_scenario(path)[0].objective.reduction, Mean)
    objective = build(write(f'{TERM}{text}\nweights.kind = "end"\n'))
    assert isinstance(objective, Terminal) and objective.cost == cost


def test_kinds_with_parameters_of_their_own(write):
    text = f'{TERM}kind = "departure_time"\n'
    objective = build(write(text))
    assert isinstance(objective, objectives.DepartureTime)
    assert objective.limit_m == pytest.approx(3.5 / 2 - 1.8 / 2)
    objective = build(write(f"{text}limit_m = 1.5\nsoftness_m = 0.1\n"))
    assert (objective.limit_m, objective.softness_m) == (1.5, 0.1)
    objective = build(write(f'{TARGET}"targets.json"'))
    assert isinstance(objective.cost, objectives.TargetDistance)
    assert objective.cost.path.points.tolist() == [[0, 3], [20, 3]]


WEIGHTS = f"{TERM}[objective.term.weights]\nkind = "


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f'{FUNCTION}"costs.py:to_numpy"', "costs.py:to_numpy.* ndarray.*Dr.Jit"),
        (f'{FUNCTION}"costs.py:detached"', "costs.py:detached.* no derivative"),
        (f'{FUNCTION}"costs.py:summed"', "costs.py:summed.* 1 numbers for 2 states"),
        (f'{FUNCTION}"costs.py:mixed"', "costs.py:mixed.* depends on another"),
        (f'{FUNCTION}"costs.py:infinite"', "costs.py:infinite.* not finite at states"),
        (f'{FUNCTION}"costs.py:kinked"', "costs.py:kinked.* derivative is not finite"),
        (f'{FUNCTION}"absent.py:f"', "absent.py: does not exist"),
        (f'{FUNCTION}"a.py:f"'.replace("true", "false"), "function: a.*trust_code = "),
        (f'{TARGET}"absent.json"', "absent.json"),
        (f'{WEIGHTS}"listed"\nlisted_weights = [1.0, 2.0]', "2 .*for a horizon of 4"),
        (f'{WEIGHTS}"last"\nlast_s = 9.0', r"last_s: 9\.0 s is 90 control periods"),
    ],
)
def test_objectives_that_cannot_be_built(write, text, message):
    with pytest.raises(InputError, match=message):
        build(write(text))


@pytest.mark.parametrize(
    ("text", "weights"),
    [
        ('kind = "linear"', [0.25, 0.5, 0.75, 1]),
        ('kind = "last"\nlast_s = 0.2', [0, 0, 1, 1]),
        ('kind = "discount"\ndiscount_per_s = 0.5', 0.5 ** (np.arange(4) / 10)),
        ('kind = "listed"\nlisted_weights = [0.0, 1.0, -1.0, 2.0]', [0, 1, -1, 2]),
    ],
)
def test_weights(write, text, weights):
    objective = build(write(f"{TERM}[objective.term.weights]\n{text}\n"))
    np.testing.assert_allclose(objective.weights, weights, rtol=1e-15)


def test_further_terms_and_reductions(write):
    text = """\
[objective.reduction]
kind = "cvar"
fraction = 0.4
[[objective.term]]
weight = 0.5
[[objective.term]]
kind = "departure_time"
weight = 3.0
[[objective.term]]
kind = "heading"
weights = { kind = "end" }
"""
    path = write(text)
    objective = build(path)
    assert isinstance(objective, WeightedSum)
    assert [weight for weight, _ in objective.terms] == [0.5, 3.0, 1.0]
    kinds = [type(term) for _, term in objective.terms]
    assert kinds == [StageSum, objectives.DepartureTime, Terminal]
    scenario, _ = load_scenario(path)
    assert scenario.objective.reduction == CVaR(0.4)
    again = type(scenario).model_validate_json(
        scenario.model_dump_json(), context={"folder": path.parent}
    )
    assert again == scenario
    worst, _ = load_scenario(write('[objective.reduction]\nkind = "worst"\n'))
    assert isinstance(worst.objective.reduction, Worst)


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


def test_examples_of_the_manual(write, tmp_path):
    """The scenario and the function in docs/howto/objective.md work as written."""
    manual = (Path(__file__).parents[2] / "docs/howto/objective.md").read_text("utf-8")
    [toml] = re.findall(r"```toml\n(.*?)```", manual, re.S)[:1]
    objective = build(write(toml))
    assert [weight for weight, _ in objective.terms] == [1.0, 0.1]
    blocks = re.findall(r"```python\n(.*?)```", manual, re.S)
    (tmp_path / "manual.py").write_text(blocks[0])
    objective = build(write(f'{FUNCTION}"manual.py:leave_to_the_right"'))
    state = dr.llvm.ad.Array3f64([0, 0], [1, -7], [0, 0])
    assert objective.cost(state).numpy().tolist() == [7, 0]
    names = {"route": ROUTE, "weights": np.ones(4)}
    exec(blocks[1], names)
    assert len(names["objective"].terms) == 2
