"""Policies with memory: frame stacks and hidden states and their derivatives."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.derivatives import central_difference
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.goals import IntegerGoal, NoGoal, OneHotGoal
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.preprocess import (
    Crop,
    Preprocess,
    Resize,
    channels_last,
    to_grey,
)
from mi_nerfattack.policy.torch_policy import TorchPolicy

pytestmark = pytest.mark.usefixtures("variant")

SIZE = (6, 8)
TYPES = {
    torch.float32: (
        lambda a: mi.TensorXf(a.astype("f4")),
        lambda a: mi.Float(a),
        1e-5,
    ),
    torch.float64: (
        lambda a: dr.llvm.ad.TensorXf64(a),
        lambda a: dr.llvm.ad.Float64(a),
        1e-9,  # rounding of the differences
    ),
}


class Linear(nn.Module):
    """A fixed weight for each value of the input."""

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
        Recurrent().to(dtype), OneHotGoal(2), recurrent=shapes, control_scale=-0.5
    )


def stacked(dtype=torch.float32):
    preprocess = Preprocess([Resize(5, 4)], frames=3, stride=2)
    return TorchPolicy(Linear(9, 4, 5).to(dtype), NoGoal(), preprocess)


def pilotnet(dtype=torch.float32):
    preprocess = Preprocess([Resize(200, 66)])
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
        control, parts = twin.step(exact(image + s * t_image), 1, moved)
        pairs = zip(parts, d_after, strict=True)
        return control.numpy() @ weight + sum(float((p * d).sum()) for p, d in pairs)

    d_image, d_memory = policies[dtype].step_vjp(
        tensor(image), 1, memory, row(weight), d_after
    )
    assert type(d_image) is type(tensor(image))
    products = [d_image.numpy() * t_image]
    pairs = zip(d_memory, t_memory, strict=True)
    products += [(d * t).numpy() for d, t in pairs]
    scale = sum(np.abs(p).sum() for p in products)
    expected = pytest.approx(central_difference(value, 1e-4), abs=tolerance * scale)
    assert sum(p.sum() for p in products) == expected


@pytest.mark.parametrize("make", [recurrent, stacked])
def test_reverse_mode_through_time_equals_differences(make, rng):
    """Chain step_vjp over five steps; compare with differences of the whole chain."""
    tensor, row, _ = TYPES[torch.float64]
    policy = make(torch.float64)
    values = [rng.random((2, *SIZE, 3)) for _ in range(5)]
    directions = [rng.normal(size=(2, *SIZE, 3)) for _ in range(5)]
    weights = rng.normal(size=(5, 2))

    def objective(step):
        images = [tensor(v + step * d) for v, d in zip(values, directions, strict=True)]
        return float(np.sum(weights * drive(policy, images)[0]))

    images = [tensor(v) for v in values]
    _, memories = drive(policy, images)
    d_memory, total = (), 0.0
    for i in reversed(range(5)):
        weight = row(weights[i])
        d_image, d_memory = policy.step_vjp(images[i], 1, memories[i], weight, d_memory)
        total += float((d_image.numpy() * directions[i]).sum())
    numeric = (objective(1e-5) - objective(-1e-5)) / 2e-5
    assert total == pytest.approx(numeric, rel=1e-7)


def test_control_and_vjp_are_those_of_first_images(rng):
    policy = recurrent()
    image, weight = mi.TensorXf(rng.random((2, *SIZE, 3), "f4")), mi.Float(1, -1)
    memory = policy.initial_memory(2)
    control, d_image = policy.vjp(image, 0, weight)
    # torch fuses the LSTM where it records no graph: the last bit may differ
    np.testing.assert_allclose(control, policy.control(image, 0), atol=1e-6)
    np.testing.assert_allclose(control, policy.step(image, 0, memory)[0], atol=1e-6)
    expected, _ = policy.step_vjp(image, 0, memory, weight, ())
    np.testing.assert_array_equal(d_image, expected)


def test_frame_stack_repeats_the_first_image_and_keeps_the_stride(rng):
    preprocess = Preprocess(frames=3, stride=2)
    frames = torch.arange(7.0)[:, None, None, None, None].expand(-1, 1, 1, 1, 1)
    past = torch.zeros(1, 0, 0, 0, 0)
    seen = []
    for frame in frames:
        stacked, past = preprocess.stack(frame, past)
        assert past.shape[1] <= preprocess.history == 4
        seen.append(stacked.flatten().tolist())
    # no frame that has dropped out is kept
    assert past.untyped_storage().nbytes() == past.numel() * 4 == 4 * 4
    assert seen == [
        [0, 0, 0],
        [0, 0, 1],
        [0, 0, 2],
        [0, 1, 3],
        [0, 2, 4],
        [1, 3, 5],
        [2, 4, 6],
    ]


def test_planes_are_the_stack_after_its_transforms(rng):
    stack = Preprocess([Crop(2, 0, 1, 1), to_grey()], frames=3, layout=channels_last)
    policy = TorchPolicy(nn.Flatten(), NoGoal(), stack, output=0)
    height, width = 6, 8
    images = [rng.random((2, height, width, 3), "f4") for _ in range(4)]
    memory = policy.initial_memory(2)
    for image in map(mi.TensorXf, images[:3]):
        _, memory = policy.step(image, 0, memory)
    found = policy.planes(mi.TensorXf(images[3]), memory)
    weights = np.array([0.299, 0.587, 0.114])
    expected = np.stack([image[:, 2:, 1:-1] @ weights for image in images[1:]], 1)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_memory_is_left_alone(rng):
    policy = recurrent()
    images = [mi.TensorXf(rng.random((3, *SIZE, 3), "f4")) for _ in range(2)]
    _, memories = drive(policy, images)
    before = [part.clone() for part in memories[1]]
    first, _ = policy.step(images[1], 1, memories[1])
    policy.step_vjp(images[1], 1, memories[1], mi.Float(1, 1, 1), ())
    again, _ = policy.step(images[1], 1, memories[1])
    np.testing.assert_array_equal(first, again)
    assert all(map(torch.equal, before, memories[1]))
    assert TorchPolicy(Linear(3, *SIZE), NoGoal()).initial_memory(2) == ()


def test_vehicles_do_not_mix(rng):
    """A batch gives what its members give alone."""
    policy = recurrent(torch.float64)
    tensor = TYPES[torch.float64][0]
    values = [rng.random((2, *SIZE, 3)) for _ in range(3)]
    together, _ = drive(policy, [tensor(v) for v in values])
    for i in range(2):
        alone, _ = drive(policy, [tensor(v[i : i + 1]) for v in values])
        np.testing.assert_allclose(
            np.ravel(alone), np.array(together)[:, i], rtol=1e-12
        )


@pytest.mark.parametrize("shape", [(3, 4), (-1, -1), (-1, 0)])
def test_hidden_shapes_need_one_place_for_the_vehicles(shape):
    with pytest.raises(InputError, match="one -1"):
        TorchPolicy(Recurrent(), NoGoal(), recurrent=[shape])


def test_goals_as_networks_take_them():
    goals, like = torch.tensor([2, 0]), torch.zeros(1, dtype=torch.float64)
    assert torch.equal(IntegerGoal(3).arguments(goals, like)[0], goals)
    (rows,) = OneHotGoal(3).arguments(goals, like)
    assert rows.tolist() == [[0, 0, 1], [1, 0, 0]] and rows.dtype == torch.float64
    assert NoGoal().arguments(goals, like) == ()
    for kind in (IntegerGoal, OneHotGoal):
        with pytest.raises(InputError, match="below 2"):
            kind(2).arguments(goals, like)
        with pytest.raises(InputError, match="at least 1"):
            kind(0)
