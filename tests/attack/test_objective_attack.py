"""Attacks on a toy loop make every kind of objective smaller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import toy_loop as toy

from mi_nerfattack.attack.base import best_so_far
from mi_nerfattack.attack.objectives import (
    AbsoluteDeviation,
    CrossTrackDeviation,
    DepartureTime,
    HeadingDeviation,
    TargetDistance,
)
from mi_nerfattack.attack.user_cost import UserCost
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.posed import move_all
from mi_nerfattack.rollout.objective import StageSum, Terminal, WeightedSum
from mi_nerfattack.rollout.reduction import CVaR, Mean, Worst
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

HORIZON, ITERATIONS = 6, 5
TARGET = Route("target", 0, toy.ROUTE.points + [0.0, 0.6])


@pytest.fixture(scope="module")
def loop():
    """The toy loop, whose kernels all cases share."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return toy.make_loop()


def rightwards(state):
    return state[1]


CASES = {
    "cross_track": (StageSum(CrossTrackDeviation(toy.ROUTE)), Mean()),
    "absolute": (StageSum(AbsoluteDeviation(toy.ROUTE)), Mean()),
    "end": (Terminal(AbsoluteDeviation(toy.ROUTE)), Worst()),
    "heading": (StageSum(HeadingDeviation(toy.ROUTE)), Mean()),
    "target": (StageSum(TargetDistance(TARGET)), CVaR(0.5)),
    "departure": (DepartureTime(toy.ROUTE, 0.4, 0.15), CVaR(0.6)),
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


@pytest.mark.parametrize("name", CASES)
def test_an_attack_makes_it_smaller(loop, name):
    from mi_nerfattack.attack.freedom import Freedom
    from mi_nerfattack.attack.gradient import GradientAttack
    from mi_nerfattack.rollout.function import Rollout

    closed, grid = loop
    texture = toy.texture_of(grid)
    initial = closed.initial(np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.05]]))
    rollout = Rollout(closed, CASES[name][0], HORIZON, CASES[name][1])
    attack = GradientAttack(rollout, toy.ROUTE, initial, Freedom(0.3))
    for _ in range(ITERATIONS):
        attack.step()
    last = attack.measure().objective
    grid.set_parameter("texture", texture)
    first = attack.history[0].objective
    assert last < first - 0.01 * abs(first)


def test_the_curve_counts_drives_and_passes_back(loop):
    """Two poses over six periods are 12 frames; a pass back costs 1.5 drives here."""
    from mi_nerfattack.attack.freedom import Freedom
    from mi_nerfattack.attack.gradient import GradientAttack
    from mi_nerfattack.rollout.function import Rollout

    closed, grid = loop
    texture = toy.texture_of(grid)
    initial = closed.initial(np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.05]]))
    rollout = Rollout(closed, CASES["absolute"][0], HORIZON)
    attack = GradientAttack(rollout, toy.ROUTE, initial, Freedom(0.3))
    assert attack.curve(1.5).shape == (0, 3)
    attack.step()
    attack.step()
    before = closed.sensor.renders
    attack.finish()
    curve, (first, second) = attack.curve(1.5), attack.history
    grid.set_parameter("texture", texture)
    assert closed.sensor.renders - before == 12
    assert curve[:, 0].tolist() == [12, 12 + 30, 12 + 60]
    assert curve[0, 1:].tolist() == [first.objective, first.cross_track_mean_m]
    assert curve[1, 1] == min(first.objective, second.objective)
    assert curve[2, 1] == attack.best_objective < first.objective
    assert curve[2, 2] == attack.best_mean_m


def test_the_curve_keeps_the_first_of_the_best():
    found = best_so_far([2, 4, 6, 8], [-1.0, 3.0, -1.0, -2.0], [0.1, 0.4, 0.3, 0.2])
    assert found.tolist() == [
        [2, -1.0, 0.1],
        [4, -1.0, 0.1],
        [6, -1.0, 0.1],
        [8, -2.0, 0.2],
    ]


def test_what_has_no_gradient_is_told(loop):
    """By a policy that looks at nothing, also after the attack was resumed."""
    from mi_nerfattack.attack.freedom import Freedom
    from mi_nerfattack.attack.gradient import GradientAttack
    from mi_nerfattack.rollout.function import Rollout

    closed, grid = loop
    texture = toy.texture_of(grid)
    initial = closed.initial(np.array([[0.0, 0.1, 0.0]]))
    blind = toy.SmoothPolicy()
    blind.weight.data.zero_()
    freedom = Freedom(0.3, 0.02)
    for policy, expected in ((closed.policy, []), (TorchPolicy(blind), [0])):
        one = replace(closed, policy=policy)
        rollout = Rollout(one, CASES["absolute"][0], 3)
        attack = GradientAttack(rollout, toy.ROUTE, initial, freedom)
        assert attack.without_gradient == []  # nothing is known yet
        attack.step()
        again = GradientAttack(rollout, toy.ROUTE, initial, freedom)
        again.load_tensors(attack.tensors())
        grid.set_parameter("texture", texture)
        move_all(attack.sensor.objects, np.zeros((1, 6)))
        assert attack.without_gradient == again.without_gradient == expected
