"""Policies with memory: frame stacks, hidden states, and derivatives through time."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from support.faults.refusals import refusals
from support.reference import loop as analytic
from support.reference.derivatives import central_difference
from support.worlds.loops import ADJOINTS, Wave, assert_close, expected_gradient, flat
from torch import nn

from mi_nerfattack.policy import preprocess as pre
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.inputs import IntegerGoal, NoGoal, OneHotGoal
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.vehicle.dynamics import to_state

pytestmark = pytest.mark.usefixtures("variant")

SIZE = (6, 8)
TYPES = {
    torch.float32: (lambda a: mi.TensorXf(a.astype("f4")), lambda a: mi.Float(a), 1e-5),
    torch.float64: (
        lambda a: dr.llvm.ad.TensorXf64(a),
        lambda a: dr.llvm.ad.Float64(a),
        1e-9,  # rounding of the differences
    ),
}


class Linear(nn.Module):
    def __init__(self, *shape):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(shape) / 4)

    def forward(self, image):
        return (image * self.weight).flatten(1).sum(1)


class Recurrent(nn.Module):
    """Convolution, LSTM and a goal as a one-hot row; gives a column (n, 1)."""

    def __init__(self):
        super().__init__()
        self.features = nn.Conv2d(3, 2, 3, stride=2)
        self.memory = nn.LSTM(14, 5)
        self.head = nn.Linear(5, 1)

    def forward(self, image, goal, hidden, cell):
        features = torch.tanh(self.features(image)).flatten(1)
        features = torch.cat([features, goal], 1)[None]
        out, (hidden, cell) = self.memory(features, (hidden, cell))
        return self.head(out[0]), hidden, cell


def recurrent(dtype=torch.float32):
    shapes = [(1, -1, 5), (1, -1, 5)]
    return TorchPolicy(
        Recurrent().to(dtype),
        OneHotGoal(2),
        recurrent=shapes,
        action=Action(scale=-0.5),
    )


def stacked(dtype=torch.float32):
    preprocess = pre.Preprocess([pre.Resize(5, 4)], frames=3, stride=2)
    return TorchPolicy(Linear(9, 4, 5).to(dtype), NoGoal(), preprocess)


def pilotnet(dtype=torch.float32):
    preprocess = pre.Preprocess([pre.Resize(200, 66)])
    return TorchPolicy(PilotNet().to(dtype), IntegerGoal(3), preprocess)


def drive(policy, images, goal=1):
    """Return the memories before each image, and the one after the last."""
    memories = [policy.initial_memory(len(images[0]))]
    controls = []
    for image in images:
        control, after = policy.step(image, goal, memories[-1])
        controls.append(control.numpy())
        memories.append(after)
    return controls, memories


@pytest.mark.parametrize("dtype", TYPES, ids=str)
@pytest.mark.parametrize("make", [pilotnet, recurrent, stacked])
def test_reverse_mode_of_a_step_equals_differences(make, dtype, rng):
    """By image and memory; the differences are those of a twin in double precision."""
    tensor, row, tolerance = TYPES[dtype]
    image, t_image = rng.random((2, *SIZE, 3)), rng.normal(size=(2, *SIZE, 3))
    policies = {}
    for kind in (torch.float64, dtype):
        torch.manual_seed(7)
        policies[kind] = make(kind)
    twin, exact = policies[torch.float64], TYPES[torch.float64][0]
    _, memories = drive(twin, [exact(rng.random(image.shape)) for _ in range(2)])
    memory = memories[-1]
    t_memory = tuple(torch.randn_like(part) for part in memory)
    _, after = twin.step(exact(image), 1, memory)
    weight, d_after = rng.normal(size=2), tuple(map(torch.randn_like, after))

    def value(s):
        moved = tuple(m + s * t for m, t in zip(memory, t_memory, strict=True))
        control, memory_after = twin.step(exact(image + s * t_image), 1, moved)
        pairs = zip(memory_after, d_after, strict=True)
        return control.numpy() @ weight + sum(float((p * d).sum()) for p, d in pairs)

    d_image, d_memory, _ = policies[dtype].step_vjp(
        tensor(image), 1, memory, row(weight), d_after
    )
    assert type(d_image) is type(tensor(image))
    products = [d_image.numpy() * t_image]
    pairs = zip(d_memory, t_memory, strict=True)
    products += [(d * t).numpy() for d, t in pairs]
    scale = sum(np.abs(p).sum() for p in products)
    expected = pytest.approx(central_difference(value, 1e-4), abs=tolerance * scale)
    assert sum(p.sum() for p in products) == expected


def test_frame_stack_repeats_the_first_image_and_keeps_the_stride():
    preprocess = pre.Preprocess(frames=3, stride=2)
    past, stacks = torch.zeros(1, 0, 0, 0, 0), []
    for frame in torch.arange(7.0):
        stacked, past = preprocess.stack(frame.expand(1, 1, 1, 1), past)
        assert past.shape[1] <= preprocess.history == 4
        stacks.append([int(value) for value in stacked.flatten()])
    # no frame that has dropped out is kept
    assert past.untyped_storage().nbytes() == past.numel() * 4 == 4 * 4
    first = [[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 1, 3]]
    assert stacks == [*first, [0, 2, 4], [1, 3, 5], [2, 4, 6]]


def test_planes_are_the_stack_after_its_transforms(rng):
    stack = pre.Preprocess(
        [pre.Crop(2, 0, 1, 1), pre.to_grey()], frames=3, layout=pre.channels_last
    )
    policy = TorchPolicy(nn.Flatten(), NoGoal(), stack, action=Action(output=0))
    images = [rng.random((2, *SIZE, 3), "f4") for _ in range(4)]
    memory = policy.initial_memory(2)
    for image in map(mi.TensorXf, images[:3]):
        _, memory = policy.step(image, 0, memory)
    planes = policy.planes(mi.TensorXf(images[3]), memory)
    weights = np.array([0.299, 0.587, 0.114])
    expected = np.stack([image[:, 2:, 1:-1] @ weights for image in images[1:]], 1)
    np.testing.assert_allclose(planes, expected, atol=1e-6)


def of_shape(*shape):
    return lambda: TorchPolicy(Recurrent(), NoGoal(), recurrent=[shape])


def too_few(kind, goals=(2, 0)):
    return lambda: kind(2).arguments(torch.tensor(goals), torch.tensor(goals))


test_goals_and_shapes_that_are_refused = refusals(
    *((too_few(kind), "below 2") for kind in (IntegerGoal, OneHotGoal)),
    *((lambda k=kind: k(0), "at least 1") for kind in (IntegerGoal, OneHotGoal)),
    *((of_shape(*shape), "one -1") for shape in ((3, 4), (-1, -1), (-1, 0))),
)


HORIZON = 7


class Gated(nn.Module):
    def __init__(self):
        super().__init__()
        size = 3 * analytic.HEIGHT * analytic.WIDTH
        self.cell = nn.GRUCell(size + 3, 6)
        self.head = nn.Linear(6, 1)

    def forward(self, image, goal, hidden):
        hidden = self.cell(torch.cat([3 * image.flatten(1), goal], 1), hidden)
        return 2 * torch.tanh(2 * self.head(hidden)), hidden


class Dense(nn.Module):
    def __init__(self):
        super().__init__()
        self.head = nn.Linear(9 * 2 * 4, 1)

    def forward(self, image):
        return torch.tanh(2 * self.head(image.flatten(1)))


def policies():
    torch.manual_seed(4)
    transforms = [pre.Resize(4, 2), pre.to_yuv(), pre.Normalise(2.0, (0.5,), (0.7,))]
    stack = pre.Preprocess(transforms, 3, 2)
    return {
        "recurrent": TorchPolicy(Gated().double(), OneHotGoal(3), recurrent=[(-1, 6)]),
        "stacked": TorchPolicy(
            Dense().double(), NoGoal(), stack, action=Action(scale=-1.5)
        ),
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
        return policy.action.scale * result[0][:, 0]


def make_pair(name):
    policy = policies()[name]
    loop, twin = analytic.make_pair("ackermann", substeps=2, delay=1)
    loop = replace(loop, policy=policy)
    twin = replace(twin, module=Carried(policy))
    return loop, twin, loop.dynamics.extend(analytic.random_poses(3))


@pytest.mark.parametrize("adjoint", ADJOINTS.values(), ids=ADJOINTS)
@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("name", ["recurrent", "stacked"])
def test_gradients_go_through_the_memory(name, attached, adjoint):
    loop, twin, initial = make_pair(name)
    value, expected = expected_gradient(loop, twin, initial, HORIZON, attached)
    rollout = Rollout(loop, Wave(), HORIZON, adjoint=adjoint, attached=attached)
    evaluation = rollout.run(to_state(initial))
    assert evaluation.value == pytest.approx(value, rel=1e-12)
    assert_close(flat(rollout.gradient(evaluation)), expected, 1e-9)
