"""Derivatives of drives whose policy is told speed, route and time besides images."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
import torch
from support.reference import loop as analytic
from support.reference.derivatives import central_difference
from support.worlds.loops import ADJOINTS, Wave, flat

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.action import Action, Trajectory
from mi_nerfattack.policy.base import Numbers
from mi_nerfattack.policy.inputs import Inputs
from mi_nerfattack.policy.preprocess import Preprocess
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.vehicle.dynamics import to_state
from mi_nerfattack.vehicle.integrators import RK4
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.user_model import FunctionDynamics

pytestmark = pytest.mark.usefixtures("variant")

ROUTE = Route("bend", 1, np.array([[-3.0, 0], [2, 0], [4, 1], [9, 1.5]]))
NUMBERS = Numbers(speed=True, route_m=(2.0, 4.0), time=True)
TIMES = 0.4, 0.8, 1.2


def car(state, control):
    """A car that slows down where it turns; its fourth row is its speed."""
    _, _, theta, speed = state
    turn = speed * control / 4
    pull = 3 - speed - 4 * dr.square(control)
    return speed * dr.cos(theta), speed * dr.sin(theta), turn, pull


class Waypoints(torch.nn.Module):
    """Bends positions along the route by what it sees and by its speed."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(5)
        self.image = torch.nn.Linear(72, 6).double()

    def forward(self, image, speed, route, time):
        features = torch.tanh(self.image(image.flatten(1))).reshape(-1, 3, 2)
        ahead = route[:, :1] * torch.tensor(TIMES)[:, None].to(route)
        return (
            ahead * (1 + 0.1 * torch.sin(time))[:, None]
            + 0.2 * speed[:, None] * features
        )


def make_loop(frames=1):
    loop, _ = analytic.make_pair()
    inputs = Inputs(("image", "speed", "route", "time"), NUMBERS)
    follow = Trajectory(TIMES, ("steering",), 2.0, 0.5, 0.3)
    module = Waypoints()
    if frames > 1:
        module = Newest(module)
    policy = TorchPolicy(
        module,
        preprocess=Preprocess(frames=frames),
        action=Action(trajectory=follow),
        inputs=inputs,
    )
    model = FunctionDynamics(car, 4, 0.9, (2.5,))
    return replace(loop, policy=policy, dynamics=model, integrator=RK4(), route=ROUTE)


class Newest(torch.nn.Module):
    """Weighs the newest frame and the one before."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, image, *numbers):
        return self.network(0.7 * image[:, 3:] + 0.3 * image[:, :3], *numbers)


def slopes(rollout, initial, gradient):
    """Slopes of the cost by initial states and textures: differences and adjoint."""
    rng, sensor = np.random.default_rng(1), rollout.loop.sensor
    way = rng.normal(size=initial.shape)
    (texture,) = (t.numpy().copy() for t in sensor.textures())
    look = rng.normal(size=texture.shape)

    def by_start(s):
        return rollout.measure(to_state(initial + s * way)).value

    def by_texture(s):
        sensor.set_textures([analytic.tensor(texture + s * look)])
        cost = rollout.measure(to_state(initial)).value
        sensor.set_textures([analytic.tensor(texture)])
        return cost

    yield central_difference(by_start, 1e-4), (np.array(gradient.initial).T * way).sum()
    derivative = (gradient.textures[0].numpy() * look).sum()
    yield central_difference(by_texture, 1e-4), derivative


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
@pytest.mark.parametrize("frames", [1, 2])
def test_attached_derivatives_are_those_of_the_whole_loop(adjoint, frames):
    loop = make_loop(frames)
    rollout = Rollout(loop, Wave(), 10, adjoint=adjoint, attached=True)
    initial = loop.dynamics.extend(analytic.random_poses(2))
    gradient = rollout.gradient(rollout.run(to_state(initial)))
    for difference, derivative in slopes(rollout, initial, gradient):
        assert derivative == pytest.approx(difference, rel=1e-6)


def test_detached_ones_leave_out_the_image_alone():
    """Along a path of the camera, they are those of the loop, numbers included."""
    loop = make_loop()
    initial = loop.dynamics.extend(analytic.random_poses(2))
    detached = Rollout(loop, Wave(), 10)
    opened = detached.open_loop(to_state(initial))
    gradient = opened.gradient(opened.run(to_state(initial)))
    for difference, derivative in slopes(opened, initial, gradient):
        assert derivative == pytest.approx(difference, rel=1e-6)
    same = detached.gradient(detached.run(to_state(initial)))
    for actual, expected in zip(flat(same), flat(gradient), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-9)


def test_a_batch_is_its_drives():
    loop = make_loop()
    initial = loop.dynamics.extend(analytic.random_poses(3))
    rollout = Rollout(loop, Wave(), 6)
    every = rollout.measure(to_state(initial)).trajectory.states_numpy()
    for row, states in zip(initial, every, strict=True):
        alone = rollout.measure(to_state(row[None])).trajectory.states_numpy()
        np.testing.assert_allclose(alone[0], states, atol=1e-12)


def test_what_cannot_be_told_is_refused():
    loop = replace(make_loop(), route=None)
    initial = loop.initial(analytic.random_poses(1))
    with pytest.raises(InputError, match="route: the policy is told points of it"):
        Rollout(loop, Wave(), 2).measure(initial)
