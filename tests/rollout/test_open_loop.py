"""Rollouts, and attacks, on the observations along an unattacked drive."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.worlds import loops as toy
from support.worlds.loops import ADJOINTS

from mi_nerfattack.attack.base import Freedom, IterationRecord, distances
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.objectives import CrossTrackDeviation
from mi_nerfattack.attack.plan import Plan, Schedule
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.adjoint import KeptBackgrounds
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.rollout.sweep import StepRecorder

pytestmark = pytest.mark.usefixtures("variant")

HORIZON = 6


@pytest.fixture
def closed():
    loop, field = toy.make_loop()
    initial = loop.initial(np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.05]]))
    rollout = Rollout(loop, StageSum(CrossTrackDeviation(toy.ROUTE)), HORIZON)
    return rollout, initial, field


def test_unattacked_it_is_the_closed_loop(closed):
    rollout, initial, _ = closed
    opened = rollout.open_loop(initial)
    first, second = (r.run(initial).trajectory for r in (rollout, opened))
    np.testing.assert_allclose(first.states_numpy(), second.states_numpy(), atol=1e-6)


def test_images_do_not_follow_the_vehicle(closed):
    """From another start, the policy does the same as along the nominal path."""
    rollout, initial, _ = closed
    opened = rollout.open_loop(initial)
    elsewhere = rollout.loop.initial(np.array([[0.0, -0.7, 0.1], [0.0, 0.6, -0.2]]))
    expected = opened.measure(initial).trajectory.controls_numpy()
    controls = opened.measure(elsewhere).trajectory.controls_numpy()
    np.testing.assert_array_equal(controls, expected)
    closed_ones = rollout.measure(elsewhere).trajectory.controls_numpy()
    assert np.abs(closed_ones - expected).max() > 1e-3


def test_one_frame_is_shown_at_all_times(closed):
    rollout, initial, _ = closed
    nominal = rollout.measure(initial).trajectory.controls_numpy()
    controls = rollout.open_loop(initial, 3).measure(initial).trajectory
    expected = np.repeat(nominal[:, 3:4], HORIZON, axis=1)
    np.testing.assert_allclose(controls.controls_numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
def test_one_frame_is_rendered_once(closed, adjoint):
    """Also for the gradient, whatever the adjoint keeps."""
    rollout, initial, _ = closed
    sensor = rollout.loop.sensor
    opened = replace(rollout.open_loop(initial, 3), adjoint=adjoint)
    before = sensor.renders
    opened.gradient(opened.run(initial))
    assert (sensor.renders - before, opened.frames) == (2, 1)  # two vehicles
    assert rollout.open_loop(initial).frames == rollout.frames == HORIZON


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
@pytest.mark.parametrize("frame", [None, 2])
def test_its_gradient_is_its_derivative(closed, frame, adjoint):
    rollout, initial, field = closed
    opened = replace(rollout.open_loop(initial, frame), adjoint=adjoint)
    texture = toy.texture_of(field)
    gradient = opened.gradient(opened.run(initial)).textures[0].numpy()
    rng = np.random.default_rng(2)
    way = rng.normal(size=texture.shape).astype(np.float32)
    recorder = StepRecorder([way])
    attribution = opened.gradient(opened.run(initial), recorder=recorder).attribution
    assert np.count_nonzero(attribution.along) > 1
    total = float((gradient * way).sum())
    assert attribution.along.sum() == pytest.approx(total, rel=1e-4)

    def value(s):
        rollout.loop.sensor.set_textures([texture + s * way])
        return opened.measure(initial).value

    slope = (value(0.02) - value(-0.02)) / 0.04
    assert slope == pytest.approx(total, rel=0.02)


def test_an_attack_by_it_makes_the_closed_loop_worse(closed):
    rollout, initial, field = closed
    opened = rollout.open_loop(initial)
    before = rollout.measure(initial).value
    attack = GradientAttack(opened, toy.ROUTE, initial, Freedom(0.3))
    for _ in range(5):
        attack.step()
    attack.restore_best()
    evaluation = rollout.measure(initial)
    assert evaluation.value < before - 0.01 * abs(before)
    through = attack.measure_through(rollout.loop.sensor)  # in the closed loop
    assert through == distances(toy.ROUTE, evaluation).mean()


@pytest.mark.parametrize(
    "options",
    [{}, {"smoothing": 2}, {"constraints": Constraints(total_variation=0.5)}],
    ids=str,
)
def test_small_steps_gain_what_the_gradient_predicts(closed, options):
    """Of images whose camera stays, which is what a detached gradient is of."""
    rollout, initial, _ = closed
    colouring = partial(Colours, **options)
    freedom = Freedom(0.003, colouring=colouring)
    opened = rollout.open_loop(initial)
    attack = GradientAttack(opened, toy.ROUTE, initial, freedom)
    assert attack.rows() == [] and attack.least_gain is None
    for _ in range(5):
        attack.step()
    again = GradientAttack(opened, toy.ROUTE, initial, freedom)
    again.load_tensors(attack.tensors())
    assert again.history == attack.history
    assert again.predicted_gains == attack.predicted_gains
    attack.finish()
    rows, least = attack.rows(), attack.least_gain
    for row in rows:
        assert row["gain"] == pytest.approx(row["predicted_gain"], rel=0.05)
        assert row["gain"] > 0
    assert least["first"] == 0
    assert least["predicted"] == pytest.approx(sum(r["predicted_gain"] for r in rows))
    assert least["gain"] == pytest.approx(
        rows[0]["objective"] - attack.judged_objective, rel=1e-6
    )
    with pytest.raises(InputError, match="5 iterations, 4 predicted gains"):
        again.load_tensors(
            attack.tensors() | {"predicted_gains": np.array(attack.predicted_gains[1:])}
        )


def test_the_least_gain_is_of_iterations_that_predict_a_fall(closed):
    """At the full rates: windows of five predict 15, 5, -5, 1 and 0.5."""
    rollout, initial, _ = closed
    attack = GradientAttack(rollout, toy.ROUTE, initial, Freedom(0.1))
    attack.predicted_gains = [11.0, 1.0, 1.0, 1.0, 1.0, 1.0, -9.0, 7.0]
    falls = [3.0, 1.0, 1.0, 1.0, 1.0, 0.0, -9.0, 6.5]
    objectives = -np.cumsum([0.0, *falls])
    attack.history = [IterationRecord(k, v, 0.1, 0.2) for k, v in enumerate(objectives)]
    attack.predicted_gains.append(0.5)  # whose gain is not known yet: 0
    assert attack.least_gain == {"first": 4, "predicted": 0.5, "gain": -1.5}
    attack.plan = Plan(Schedule(12))  # whose rates fall after nine iterations
    assert attack.plan.schedule.full(list(objectives)) == 9
    attack.plan = Plan(Schedule(10))  # after eight
    assert attack.least_gain == {"first": 3, "predicted": 1.0, "gain": -0.5}
    attack.plan = Plan(Schedule(5))  # after four, which are too few
    assert attack.least_gain is None


def test_gains_of_poses_are_recorded(closed):
    rollout, initial, _ = closed
    attack = GradientAttack(rollout, toy.ROUTE, initial, Freedom(None, 0.01))
    attack.step()  # of poses alone
    attack.finish()
    (row,) = attack.rows()
    assert row["predicted_gain"] > 0 and row["gain"] != 0


def test_what_makes_no_sense_is_refused(closed):
    rollout, initial, _ = closed
    attached = replace(rollout.open_loop(initial), attached=True)
    evaluation = attached.run(initial)
    keeping = replace(rollout, adjoint=KeptBackgrounds())
    measured = rollout.measure(initial).trajectory
    for call, message in (
        (lambda: rollout.open_loop(initial, HORIZON), "frame: 6; .* 6"),
        (lambda: attached.gradient(evaluation), "attached to false"),
        (lambda: attached.by_images(evaluation.trajectory, {1}), "attached to false"),
        (
            lambda: keeping.by_images(keeping.run(initial).trajectory, {1}),
            r"=Replay\(\)",
        ),
        (lambda: rollout.by_images(measured, {1}), r"a drive of run\(\)"),
    ):
        with pytest.raises(InputError, match=message):
            call()
