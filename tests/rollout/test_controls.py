"""Drives of a vehicle with two controls, in double precision, and their derivatives."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
import torch
from support.faults.refusals import refusals
from support.reference import loop as analytic
from support.reference.derivatives import central_difference, nothing_compiled
from support.worlds.loops import ADJOINTS, Wave, assert_close, flat

from mi_nerfattack.policy.action import Action, Trajectory
from mi_nerfattack.policy.base import Numbers
from mi_nerfattack.policy.inputs import Inputs
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.variation import Variation, Varied
from mi_nerfattack.vehicle import (
    RK4,
    AbstractDynamics,
    Dubins,
    DynamicSingleTrack,
    FunctionDynamics,
    KinematicSingleTrack,
    TorchDynamics,
)
from mi_nerfattack.vehicle.dynamics import to_state

pytestmark = pytest.mark.usefixtures("variant")

ROLLING = KinematicSingleTrack(4.0, 0.6, 3.0, 6.0, wheelbase=2.5)
SLIPPING = DynamicSingleTrack(6.0)
#: Delays of less than a control period, and of more than three
LATE = Varied(ROLLING, Variation(delay_s_sd=0.2, seed=8), 0.025)
VEHICLES = {"rolling": ROLLING, "slipping": SLIPPING, "late": LATE}


class TwoControls(analytic.AnalyticPolicy):
    """A steering angle and an acceleration, of different parts of the image."""

    def forward(self, image: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        steering = 0.4 * super().forward(image, goal)
        acceleration = -3.0 * super().forward(image.flip(3), goal)
        return torch.stack([steering, acceleration], 1)


class Remembering(TwoControls):
    """The same with a hidden state, by which periods are linked."""

    def forward(self, image, goal, hidden):
        control = super().forward(image, goal) + 0.3 * hidden
        return control, torch.tanh(control)


def make_loop(vehicle: AbstractDynamics = ROLLING, delay=0, memory=False, objects=1):
    module = Remembering() if memory else TwoControls()
    recurrent = [(-1, 2)] if memory else []
    policy = TorchPolicy(module, recurrent=recurrent, action=Action((0, 1)))
    sensor = analytic.AnalyticSensor(analytic.random_textures(objects))
    return ClosedLoop(sensor, policy, 1, vehicle, RK4(), 0.1, 4, delay, eight_bit=False)


def gradient(rollout, poses):
    return rollout.gradient(rollout.run(rollout.loop.initial(poses)))


@pytest.mark.parametrize(
    ("vehicle", "delay", "memory"),
    [
        ("rolling", 0, False),
        ("rolling", 5, False),
        ("rolling", 5, True),
        ("slipping", 3, False),
        ("late", 3, False),
        ("late", 0, True),
    ],
)
def test_attached_gradient_is_that_of_the_whole_loop(vehicle, delay, memory, rng):
    loop = make_loop(VEHICLES[vehicle], delay, memory)
    rollout, poses = Rollout(loop, Wave(), 8, attached=True), analytic.random_poses(2)
    start = loop.dynamics.extend(poses)
    derivative = rollout.gradient(rollout.run(to_state(start)))
    (base,) = [texture.numpy().copy() for texture in loop.sensor.textures()]
    direction, along = rng.normal(size=base.shape), rng.normal(size=start.shape)
    expected = (derivative.textures[0].numpy() * direction).sum()
    expected += (np.array(derivative.initial).T * along).sum()

    def value(s):
        loop.sensor.set_textures([base + s * direction])
        return rollout.run(to_state(start + s * along)).value

    assert central_difference(value, 1e-4) == pytest.approx(expected, rel=1e-5)


class Positions(TwoControls):
    """Two positions ahead, which grow with the speed that it is told."""

    def forward(self, image, speed, goal):
        steering, acceleration = super().forward(image, goal).T
        ahead = speed[:, 0] * torch.tensor([[0.4], [0.8]]) + 0.2 * acceleration
        left = torch.stack([0.1 * steering, 0.5 * steering])
        return torch.stack([ahead, left], 2).transpose(0, 1)


def test_a_path_is_followed_by_steering_and_acceleration(rng):
    """The speed that the policy is told, and the follower uses, is the state's row."""
    follow = Trajectory((0.4, 0.8), ("steering", "acceleration"), 2.5, 1.0, 0.2)
    inputs = Inputs(("image", "speed", "goal"), Numbers(speed=True))
    policy = TorchPolicy(Positions(), action=Action(trajectory=follow), inputs=inputs)
    loop = replace(make_loop(delay=1), policy=policy)
    start = loop.dynamics.extend(analytic.random_poses(2))
    rollout = Rollout(loop, Wave(), 6, attached=True)
    evaluation = rollout.run(to_state(start))
    assert evaluation.trajectory.controls_numpy().shape == (2, 6, 2)
    by_start = np.array(rollout.gradient(evaluation).initial).T
    along = rng.normal(size=start.shape)

    def value(s):
        return rollout.run(to_state(start + s * along)).value

    expected = (by_start * along).sum()
    assert central_difference(value, 1e-4) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("memory", [False, True])
def test_the_three_ways_back_agree(attached, memory):
    """Also of several periods whose images go back through the policy at once."""
    loop, poses = make_loop(delay=3, memory=memory), analytic.random_poses(1)
    first, *others = (
        flat(gradient(Rollout(loop, Wave(), 7, adjoint=way, attached=attached), poses))
        for way in ADJOINTS.values()
    )
    assert np.abs(first[0]).max() > 0
    for other in others:
        assert_close(other, first, 1e-12)


@pytest.mark.parametrize("vehicle", ["rolling", "late"])
def test_a_batch_is_its_drives_one_by_one(vehicle):
    loop, poses = make_loop(VEHICLES[vehicle], delay=2), analytic.random_poses(3)
    rollout = Rollout(loop, Wave(), 6, attached=True)
    batch = rollout.run(loop.initial(poses))
    controls = batch.trajectory.controls_numpy()
    assert controls.shape == (3, 6, 2)
    derivative = rollout.gradient(batch)
    texture = np.zeros_like(derivative.textures[0].numpy())
    for number, pose in enumerate(poses):
        alone = replace(rollout, loop=loop.numbered(number))
        one = alone.run(loop.initial(pose))
        np.testing.assert_allclose(
            one.trajectory.controls_numpy()[0], controls[number], rtol=1e-10
        )
        own = alone.gradient(one)
        texture += own.textures[0].numpy() / 3
        by_start = np.array(derivative.initial)[:, number]
        np.testing.assert_allclose(np.array(own.initial)[:, 0] / 3, by_start, rtol=1e-8)
    np.testing.assert_allclose(derivative.textures[0].numpy(), texture, rtol=1e-8)


@pytest.mark.parametrize("vehicle", ["rolling", "late"])
def test_nothing_is_compiled_after_the_first_steps(vehicle):
    loop, poses = make_loop(VEHICLES[vehicle], delay=3), analytic.random_poses(2)
    rollout = Rollout(loop, Wave(), 6, attached=True)
    gradient(rollout, poses)
    with nothing_compiled():
        gradient(rollout, poses + 0.05)


def user_car(state, control):
    _, _, theta, speed = state
    steering, acceleration = control
    turn = speed / 2.5 * dr.tan(steering)
    return speed * dr.cos(theta), speed * dr.sin(theta), turn, acceleration


def torch_car(state, control):
    theta, speed = state[:, 2], state[:, 3]
    turn = speed / 2.5 * control[:, 0].tan()
    rows = speed * theta.cos(), speed * theta.sin(), turn, control[:, 1]
    return torch.stack(rows, 1)


def test_functions_of_the_user_take_two_controls():
    """In Dr.Jit and in torch: equal drives and gradients."""
    options = {"size": 4, "limit": (0.6, 3.0), "rest_state": (4.0,), "controls": 2}
    poses, arrays = analytic.random_poses(2), []
    for car in (
        FunctionDynamics(user_car, **options),
        TorchDynamics(torch_car, **options),
    ):
        assert car.control_names == ("control_0", "control_1")
        rollout = Rollout(make_loop(car, delay=1), Wave(), 5, attached=True)
        evaluation = rollout.run(rollout.loop.initial(poses))
        arrays.append([evaluation.trajectory.states_numpy()])
        arrays[-1] += flat(rollout.gradient(evaluation))
    assert_close(arrays[1], arrays[0], 1e-9)


def drive_with(vehicle, module, **options):
    def call():
        loop = replace(make_loop(vehicle), policy=TorchPolicy(module, **options))
        Rollout(loop, Wave(), 2).run(loop.initial(np.zeros((1, 3))))

    return call


test_refused = refusals(
    (
        drive_with(ROLLING, analytic.AnalyticPolicy()),
        "gives 1, the vehicle takes 2: steering, acceleration",
    ),
    (
        drive_with(Dubins(), TwoControls(), action=Action((0, 1))),
        "gives 2, the vehicle takes 1: heading_rate",
    ),
    (lambda: FunctionDynamics(user_car, limit=(1.0,), controls=2), r"limit: \(1.0,\)"),
)
