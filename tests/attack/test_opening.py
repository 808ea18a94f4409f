"""How a search by gradient begins, and when it follows the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.worlds import loops as toy

from mi_nerfattack.attack.base import Freedom
from mi_nerfattack.attack.black_box.random_looks import RandomLooks
from mi_nerfattack.attack.black_box.surrogate import Task
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.objectives import CrossTrackDeviation
from mi_nerfattack.attack.opening import Restarts, Sides
from mi_nerfattack.attack.plan import Plan, Schedule
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.scenario.attack import GradientMethod

pytestmark = pytest.mark.usefixtures("variant")

HORIZON = 6
SIDES = Sides(2, toy.ROUTE)
HALVES = Plan(Schedule(40, 0.1), follow="second_half")
OPENED = Plan(Schedule(38, 0.1), Sides(5, toy.ROUTE))


@pytest.fixture
def problem():
    loop, field = toy.make_loop()
    initial = loop.initial(np.array([[0.0, 0.1, 0.0]]))
    cost = StageSum(CrossTrackDeviation(toy.ROUTE))
    rollout = Rollout(loop, cost, HORIZON, attached=True)
    return rollout, initial, field


def attack_of(problem, plan):
    rollout, initial, _ = problem
    return GradientAttack(rollout, toy.ROUTE, initial, Freedom(0.1), plan)


def texture_now(attack):
    attack._install()
    return toy.texture_of(attack.sensor.fields[0])


def mean_signed(attack):
    states = attack.rollout.measure(attack.initial).trajectory.states_numpy()
    return float(toy.ROUTE.cross_track_numpy(states[0, 1:]).mean())


def test_each_try_goes_to_its_side_and_the_best_goes_on(problem):
    attack = attack_of(problem, Plan(Schedule(3), SIDES))
    attack._install()
    original, before = toy.texture_of(problem[2]), mean_signed(attack)
    sides = []
    for number in range(2):
        attack.step()
        attack.step()
        attack._install()
        sides.append(mean_signed(attack) - before)
        assert attack.plan.try_index(attack.iteration - 1) == number
    assert sides[0] > 0.001 and sides[1] < -0.001
    objectives = [record.objective for record in attack.history]
    assert objectives[0] == objectives[2]  # both begin with the original
    best = attack.best[0].copy()
    assert np.abs(best - original).max() > 0.01
    record = attack.step()
    assert record.objective == pytest.approx(min(objectives), abs=1e-6)
    rows = attack.rows()
    assert [row["gain"] is None for row in rows] == [True] * 4 + [False]
    assert [row["predicted_gain"] is None for row in rows] == [True] * 4 + [False]
    attack.step()
    assert not attack.is_over
    attack.step()
    assert attack.is_over and attack.iteration == 7


def test_an_interrupted_opening_goes_on_as_if_it_had_not_been(problem):
    plan = Plan(Schedule(3), SIDES)
    attack = attack_of(problem, plan)
    for _ in range(3):
        attack.step()
    checkpoint = attack.tensors()
    for _ in range(3):
        attack.step()
    expected = attack.tensors()
    problem[2].set_parameter("texture", attack._colourings["0"]._original)
    again = attack_of(problem, plan)
    again.load_tensors(checkpoint)
    for _ in range(3):
        again.step()
    tensors = again.tensors()
    assert tensors.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_allclose(tensors[key], value, atol=1e-6, err_msg=key)


def test_restarts_begin_with_the_original_and_then_with_random_looks(problem):
    field = problem[2]
    original = toy.texture_of(field)
    looks = RandomLooks([field], Freedom(0.1), "blobs", 5)
    attack = attack_of(problem, Plan(Schedule(2), Restarts(2, looks)))
    textures = []
    for _ in range(3):
        attack._begin()
        textures.append(texture_now(attack))
        attack.step()
        attack.step()
    np.testing.assert_allclose(textures[0], original, atol=1e-5)
    colours = Colours(field)
    for number in (1, 2):
        expected = colours.near(looks.textures(number - 1)[0])
        assert np.abs(textures[number] - original).max() > 0.1
        shown = textures[number]
        np.testing.assert_allclose(colours.near(shown), expected, atol=1e-3)
    assert np.abs(textures[1] - textures[2]).max() > 0.1
    best = min(record.objective for record in attack.history)
    assert attack.step().objective == pytest.approx(best, abs=1e-6)


def test_a_try_of_one_iteration_is_refused():
    with pytest.raises(InputError, match="each: 1; .*fewer than 2"):
        Sides(1, toy.ROUTE)


def test_colours_near_a_texture_look_like_it(problem):
    field = problem[2]
    before = toy.texture_of(field)
    colours = Colours(field)
    np.testing.assert_allclose(colours.near(before), colours.start, atol=1e-5)
    expected = np.random.default_rng(1).uniform(0.1, 0.9, colours.start.shape)
    again = colours.near(colours.texture(expected.astype(np.float32)))
    cubes = [
        value.reshape((colours.level.resolution,) * 3 + (3,))
        for value in (again, expected)
    ]
    inside = [cube[:-1, :-1, :-1] for cube in cubes]  # the last vertices lie beyond
    np.testing.assert_allclose(*inside, atol=1e-4)
    np.testing.assert_array_equal(toy.texture_of(field), before)


@pytest.mark.parametrize(
    ("opening", "count", "tried"),
    [("none", 8, 0), ("sides", 17, 4), ("restarts", 24, 6)],
)
def test_tries_are_part_of_the_iterations(problem, opening, count, tried):
    rollout, initial, _ = problem
    task = Task(rollout, toy.ROUTE, initial, Freedom(0.1), 3)
    method = GradientMethod(opening=opening, max_iterations=count)
    plan = method.build(task).plan
    assert plan.tried == tried
    assert plan.schedule.max_iterations == count - tried


@pytest.mark.parametrize(
    ("follow", "expected"),
    [
        ("always", [True] * 10),
        ("second_half", [False] * 7 + [True] * 3),
        ("in_turns", [False] * 4 + [False, True] * 3),
    ],
)
def test_when_the_gradient_follows_the_camera(problem, follow, expected):
    plan = Plan(Schedule(6), SIDES, follow)
    falling = [-float(k) for k in range(10)]
    attached = [plan.followed(problem[0], falling[:k]).attached for k in range(10)]
    assert attached == expected
    detached = replace(problem[0], attached=False)
    assert not any(plan.followed(detached, falling[:k]).attached for k in range(10))


def test_the_second_half_begins_once_the_first_has_settled():
    """Ten iterations gain 1 in all, the last two of them nothing."""
    plan = HALVES
    objectives = [-1.0, *[-2.0] * 9, -2.0, *[-2.0 - 0.1 * k for k in range(9)]]
    assert [k for k in range(21) if plan.resets_moments(objectives[:k])] == [10]
    assert plan.rate(objectives[:10]) == plan.rate(objectives[:20]) == 1.0
    assert not plan.has_converged(objectives[:10])
    assert plan.steady(objectives) == [range(8), range(10, 20)]


@pytest.mark.parametrize("plan", [HALVES, OPENED])
def test_a_part_that_gains_nothing_more_has_converged(plan):
    """The gain of the parts before counts, and what they found."""
    objectives = [-1.0, *[-2.0] * 9, -1.5, *[-2.0] * 9]
    assert not plan.has_converged(objectives[:19])
    assert plan.has_converged(objectives) and plan.rate(objectives) < 1
    assert plan.is_over([*objectives, *[-2.0] * 3])
    assert plan.steady(objectives)[-1] == range(10, 18)


def test_its_moments_are_forgotten(problem):
    """An attached step, after detached ones, is as large as a first one."""
    plan = Plan(Schedule(4), follow="second_half")
    attack = attack_of(problem, plan)
    steps = []
    for _ in range(3):
        before = attack._value("0")
        attack.step()
        steps.append(np.abs(attack._value("0") - before).max())
    assert attack.tensors()["time.0"].item() == 1  # steps of this part
    assert steps[2] == pytest.approx(steps[0], rel=1e-3)


def test_what_mattered_in_a_try_is_not_forgotten(problem):
    attack = attack_of(problem, Plan(Schedule(3), SIDES))
    attack.step()
    attack.step()
    checkpoint = attack.tensors()
    assert attack.without_gradient == []
    attack._begin()  # of the second try
    assert attack.without_gradient == []
    again = attack_of(problem, Plan(Schedule(3), SIDES))
    again.load_tensors(checkpoint | {"depended": np.zeros(1, np.uint8)})
    assert again.without_gradient == [0]


def test_in_turns_gradients_have_one_size():
    plan = Plan(Schedule(4), follow="in_turns")
    values = [np.full((2, 3), 3.0), np.full((2, 3), 4.0)]
    assert plan.gradient_scale(values) == pytest.approx(np.sqrt(12.5))
    assert plan.gradient_scale([np.zeros((2, 3))]) == 1.0
    assert Plan(Schedule(4)).gradient_scale(values) == 1.0
