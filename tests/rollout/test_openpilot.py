"""Drives by a pair of openpilot's form: attached derivatives, and rounded images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.files.openpilot import FLOAT, TIMES, UINT8, Pair
from support.reference import loop as analytic
from support.reference.derivatives import central_difference
from support.worlds.loops import ADJOINTS, Wave

from mi_nerfattack.policy.action import Action, Trajectory
from mi_nerfattack.policy.base import Numbers
from mi_nerfattack.policy.inputs import Inputs, NoGoal
from mi_nerfattack.policy.one_image import OneImage
from mi_nerfattack.policy.onnx.openpilot import PackYuv
from mi_nerfattack.policy.preprocess import Preprocess
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.vehicle.dynamics import to_state

pytestmark = pytest.mark.usefixtures("variant")

VIEWS = {"road": (slice(0, 4), slice(0, 4)), "wide": (slice(0, 4), slice(2, 6))}
PERIODS = 7  # more than the history of features is long


def make_loop(images=FLOAT):
    """Two views of the frame of a formula, and a pair whose history is 4 periods."""
    pair = Pair(older=True, size=(2, 2), width=12, count=3, images=images, gain=0.2)
    module = pair.module(stride=2).double()
    policy = TorchPolicy(
        OneImage(module, module.recurrent),
        NoGoal(),
        Preprocess((PackYuv(),), frames=2, stride=2),
        module.recurrent,
        Action(trajectory=Trajectory(tuple(TIMES[1:]))),
        Inputs(("road", "wide", "speed"), Numbers(speed=True), VIEWS),
    )
    loop, _ = analytic.make_pair(dt=0.05)
    return replace(loop, policy=policy)


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
def test_attached_derivatives_are_those_of_the_whole_loop(adjoint, rng):
    loop = make_loop()
    rollout = Rollout(loop, Wave(), PERIODS, adjoint=adjoint, attached=True)
    initial, sensor = analytic.random_poses(2), loop.sensor
    run = rollout.run(to_state(initial))
    gradient = rollout.gradient(run)
    assert np.ptp(np.array(run.trajectory.controls), axis=None) > 0.01
    way = rng.normal(size=initial.shape)

    def by_start(s):
        return rollout.measure(to_state(initial + s * way)).value

    slope = central_difference(by_start, 1e-4)
    derivative = (np.array(gradient.initial).T * way).sum()
    assert derivative == pytest.approx(slope, rel=1e-6)
    (texture,) = (t.numpy().copy() for t in sensor.textures())
    look = rng.normal(size=texture.shape)

    def by_texture(s):
        sensor.set_textures([analytic.tensor(texture + s * look)])
        return rollout.measure(to_state(initial)).value

    slope = central_difference(by_texture, 1e-4)
    derivative = (gradient.textures[0].numpy() * look).sum()
    assert derivative == pytest.approx(slope, rel=1e-6)


def test_rounded_images_have_nearly_the_derivative_of_those_that_are_not():
    gradients = []
    for images in (FLOAT, UINT8):
        rollout = Rollout(make_loop(images), Wave(), PERIODS)
        initial = to_state(analytic.random_poses(1))
        gradient = rollout.gradient(rollout.run(initial))
        gradients.append(gradient.textures[0].numpy().ravel())
    cosine = (
        gradients[0] @ gradients[1] / np.prod([np.linalg.norm(x) for x in gradients])
    )
    assert 0.98 < cosine < 1 - 1e-12
