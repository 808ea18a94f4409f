"""Memory of policies in the loop's derivatives, against autograd through time."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers import analytic_loop as analytic
from helpers.rollouts import ADJOINTS, Wave, assert_close, expected_gradient, flat
from torch import nn

from mi_nerfattack.policy.black_box import CallablePolicy
from mi_nerfattack.policy.drjit_network import DrJitNetwork
from mi_nerfattack.policy.goals import NoGoal, OneHotGoal
from mi_nerfattack.policy.preprocess import Normalise, Preprocess, Resize, to_yuv
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import simulate
from mi_nerfattack.vehicle.state import to_state

pytestmark = pytest.mark.usefixtures("variant")

HORIZON = 7


class Recurrent(nn.Module):
    """A GRU of a one-hot goal and the image."""

    def __init__(self):
        super().__init__()
        size = 3 * analytic.HEIGHT * analytic.WIDTH
        self.cell = nn.GRUCell(size + 3, 6)
        self.head = nn.Linear(6, 1)

    def forward(self, image, goal, hidden):
        hidden = self.cell(torch.cat([3 * image.flatten(1), goal], 1), hidden)
        return 2 * torch.tanh(2 * self.head(hidden)), hidden


class Stacked(nn.Module):
    """A dense layer of three frames in YUV, two control periods apart."""

    def __init__(self):
        super().__init__()
        self.head = nn.Linear(9 * 2 * 4, 1)

    def forward(self, image):
        return torch.tanh(2 * self.head(image.flatten(1)))


def policies():
    torch.manual_seed(4)
    transforms = [Resize(4, 2), to_yuv(), Normalise(2.0, (0.5,), (0.7,))]
    stack = Preprocess(transforms, 3, 2)
    return {
        "recurrent": TorchPolicy(
            Recurrent().double(), OneHotGoal(3), recurrent=[(-1, 6)]
        ),
        "stacked": TorchPolicy(Stacked().double(), NoGoal(), stack, control_scale=-1.5),
    }


class Carried(nn.Module):
    """A policy's network that keeps its memory itself, in the graph of a drive."""

    def __init__(self, policy):
        super().__init__()
        self.policy, self.frames, self.hidden = policy, [], None

    def forward(self, image, goal):
        policy, preprocess = self.policy, self.policy.preprocess
        frame = image.permute(0, 2, 3, 1)
        self.frames.append(preprocess.transform(frame))
        last, stride = len(self.frames) - 1, preprocess.stride
        ages = [i * stride for i in reversed(range(preprocess.frames))]
        stack = torch.cat([self.frames[max(0, last - age)] for age in ages], 1)
        if self.hidden is None:
            self.hidden = [torch.zeros(len(image), s[1]) for s in policy.recurrent]
        hidden = [part.double() for part in self.hidden]
        goals = policy.goal.arguments(goal, image)
        result = policy.module(stack, *goals, *hidden)
        result = result if isinstance(result, tuple) else (result,)
        self.hidden = list(result[1:])
        return policy.control_scale * result[0][:, 0]


def make(name):
    policy = policies()[name]
    loop, twin = analytic.make_pair("ackermann", substeps=2, delay=1)
    loop = replace(loop, policy=policy)
    twin = replace(twin, module=Carried(policy))
    return loop, twin, loop.dynamics.extend(analytic.random_poses(3))


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("name", ["recurrent", "stacked"])
def test_gradients_go_through_the_memory(name, attached, adjoint):
    loop, twin, initial = make(name)
    value, expected = expected_gradient(loop, twin, initial, HORIZON, attached)
    rollout = Rollout(loop, Wave(), HORIZON, adjoint=adjoint, attached=attached)
    evaluation = rollout.run(to_state(initial))
    assert evaluation.value == pytest.approx(value, rel=1e-12)
    assert_close(flat(rollout.gradient(evaluation)), expected, 1e-9)


def test_black_boxes_drive_and_are_refused():
    loop, _, initial = make("recurrent")
    policy = CallablePolicy(lambda image, *_: image.mean((1, 2, 3)) - 0.5, "mine")
    rollout = Rollout(replace(loop, policy=policy), Wave(), HORIZON)
    evaluation = rollout.run(to_state(initial))
    assert np.ptp(evaluation.trajectory.controls_numpy()) > 1e-3
    with pytest.raises(TypeError, match="CallablePolicy: a black box"):
        rollout.gradient(evaluation)


def dense():
    """Return a network of drjit.nn for the analytic images."""
    import drjit.nn as drnn

    layers = drnn.Sequential(drnn.Linear(-1, 8), drnn.Tanh(), drnn.Linear(-1, 1))
    return layers.alloc(mi.TensorXf, 3 * analytic.HEIGHT * analytic.WIDTH)


def test_drjit_networks_compile_nothing_after_the_first_step():
    loop, _, initial = make("recurrent")
    policy = TorchPolicy(DrJitNetwork(dense()), NoGoal())
    loop = replace(loop, policy=policy)
    rollout = Rollout(loop, Wave(), HORIZON)
    compiled = []

    def on_step(step):
        history = dr.kernel_history((dr.KernelType.JIT,))
        compiled.append(sum(not entry["cache_hit"] for entry in history))

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        rollout.run(to_state(initial))
        dr.kernel_history_clear()
        evaluation = rollout.run(to_state(initial), on_step)
        rollout.gradient(evaluation)
        dr.kernel_history_clear()
        rollout.gradient(evaluation, on_step=on_step)
    assert compiled == [0] * 2 * HORIZON
    assert simulate(loop, to_state(initial), 2).horizon == 2
