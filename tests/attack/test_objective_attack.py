"""Attacks on a toy loop make every kind of objective smaller."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from support.worlds import loops as toy

from mi_nerfattack.attack.base import Freedom, best_so_far
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.objectives import (
    AbsoluteDeviation,
    CrossTrackDeviation,
    DepartureTime,
    HeadingDeviation,
    TargetDistance,
)
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.attack.user_cost import UserCost
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.posed import move_all
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import (
    CVaR,
    Mean,
    StageSum,
    Terminal,
    WeightedSum,
    Worst,
)
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

HORIZON, ITERATIONS, FREEDOM = 6, 5, Freedom(0.3)
TARGET = Route("target", 0, toy.ROUTE.points + [0.0, 0.6])


@pytest.fixture(scope="module")
def loop():
    """The toy loop, whose kernels all cases share."""
    mi.set_variant("llvm_ad_rgb")
    return toy.make_loop()


def rightwards(state):
    return state[1]


CASES = {
    "cross_track": (StageSum(CrossTrackDeviation(toy.ROUTE)), Mean()),
    "absolute": (StageSum(AbsoluteDeviation(toy.ROUTE)), Mean()),
    "target": (StageSum(TargetDistance(TARGET)), CVaR(0.5)),
    "function": (StageSum(UserCost("rightwards", rightwards)), Mean()),
    "sum": (
        WeightedSum(
            (
                (1.0, DepartureTime(toy.ROUTE, 0.4, 0.15)),
                (0.2, Terminal(HeadingDeviation(toy.ROUTE))),
            )
        ),
        Worst(),
    ),
}


@contextmanager
def attack_of(loop, name, horizon=HORIZON, freedom=FREEDOM, policy=None):
    """Begin an attack from two poses; afterwards the object is as it was."""
    closed, grid = loop
    texture = toy.texture_of(grid)
    objective, reduction = CASES[name]
    closed = replace(closed, policy=policy or closed.policy)
    rollout = Rollout(closed, objective, horizon, reduction)
    initial = closed.initial(np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.05]]))
    yield GradientAttack(rollout, toy.ROUTE, initial, freedom)
    grid.set_parameter("texture", texture)
    move_all(closed.sensor.objects, np.zeros((1, 6)))


@pytest.mark.parametrize("name", CASES)
def test_an_attack_makes_it_smaller(loop, name):
    with attack_of(loop, name) as attack:
        for _ in range(ITERATIONS):
            attack.step()
        last = attack.measure().objective
    first = attack.history[0].objective
    assert last < first - 0.01 * abs(first)


def test_the_curve_counts_drives_and_passes_back(loop):
    """Two poses over six periods are 12 frames; a pass back costs 1.5 drives here."""
    with attack_of(loop, "absolute") as attack:
        assert attack.curve(1.5).shape == (0, 3)
        attack.step()
        attack.step()
        before = loop[0].sensor.renders
        attack.finish()
        curve, (first, second) = attack.curve(1.5), attack.history
    assert loop[0].sensor.renders - before == 12
    assert curve[:, 0].tolist() == [12, 12 + 30, 12 + 60]
    assert curve[0, 1:].tolist() == [first.objective, first.cross_track_mean_m]
    assert curve[1, 1] == min(first.objective, second.objective)
    assert curve[2, 1] == attack.best_objective < first.objective
    assert curve[2, 2] == attack.best_mean_m


def test_the_curve_keeps_the_first_of_the_best():
    curve = best_so_far([2, 4, 6, 8], [-1.0, 3.0, -1.0, -2.0], [0.1, 0.4, 0.3, 0.2])
    assert curve.tolist() == [
        [2, -1.0, 0.1],
        [4, -1.0, 0.1],
        [6, -1.0, 0.1],
        [8, -2.0, 0.2],
    ]


def test_an_objective_that_is_no_number_is_refused(loop):
    with attack_of(loop, "absolute") as attack:
        undefined = StageSum(lambda state: state[0] * np.nan)
        attack.rollout = replace(attack.rollout, objective=undefined)
        with pytest.raises(InputError, match="objective: nan"):
            attack.step()
        assert not attack.history and attack.best_objective == np.inf


@pytest.mark.parametrize("total_variation", [0.0, 0.1])
def test_what_has_no_gradient_is_told(loop, total_variation):
    """By a policy that looks at nothing, also after the attack was resumed.

    A penalty of the colours has a gradient, and says nothing about the policy.
    """
    blind = toy.SmoothPolicy()
    blind.weight.data.zero_()
    constraints = Constraints(total_variation=total_variation)
    colouring = partial(Colours, constraints=constraints)
    options = {"horizon": 3, "freedom": Freedom(0.3, 0.02, colouring=colouring)}
    for policy, expected in ((None, []), (TorchPolicy(blind), [0])):
        with attack_of(loop, "absolute", policy=policy, **options) as attack:
            assert attack.without_gradient == []  # nothing is known yet
            attack.step()
            with attack_of(loop, "absolute", policy=policy, **options) as again:
                again.load_tensors(attack.tensors())
        assert attack.without_gradient == again.without_gradient == expected
