"""Torch modules of users: strides, writing in place, exceptions, answers."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.inputs import IntegerGoal, NoGoal
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.policy.kinds import load_policy

pytestmark = pytest.mark.usefixtures("variant")

SIZE = (6, 8)


class Wrap(nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *arguments):
        return self.function(*arguments)


def policy(function, **arguments):
    return TorchPolicy(Wrap(function), NoGoal(), name="mine.py", **arguments)


def images(rng, n=2):
    return mi.TensorXf(rng.random((n, *SIZE, 3), dtype=np.float32))


def test_networks_may_view_what_they_convolve(rng):
    """(n, 3, h, w) is contiguous, as in training: view and convolution agree."""
    convolution = nn.Conv2d(3, 4, 3)

    def flat(x):
        assert x.is_contiguous()
        return convolution(x).view(x.size(0), -1).sum(1)

    image = images(rng)
    planes = torch.from_numpy(image.numpy().transpose(0, 3, 1, 2).copy())
    with torch.no_grad():
        expected = convolution(planes).sum((1, 2, 3))
    made = policy(flat)
    np.testing.assert_allclose(made.control(image, 0), expected, atol=1e-4)
    assert made.vjp(image, 0, mi.Float(1, 1))[1].numpy().any()


def test_networks_that_write_in_place_change_nothing_of_the_loop(rng):
    def halve(x, hidden):
        hidden.add_(1.0)
        return x.mul_(0.5).mean((1, 2, 3)), hidden

    made, image = policy(halve, recurrent=[(-1, 2)]), images(rng)
    before = image.numpy().copy()
    memory = made.initial_memory(2)
    for _ in range(2):
        control, after = made.step(image, 0, memory)
        d_image, *_ = made.step_vjp(image, 0, memory, mi.Float(1, 1), ())
        np.testing.assert_array_equal(image.numpy(), before)
        assert not memory[0].any() and bool((after[0] == 1).all())
        np.testing.assert_allclose(control, 0.5 * before.mean((1, 2, 3)), rtol=1e-5)
        np.testing.assert_allclose(d_image.numpy(), 0.5 / before[0].size, rtol=1e-5)


def raise_(error):
    raise error


@pytest.mark.parametrize("error", [MemoryError(), KeyboardInterrupt()])
def test_what_is_no_fault_of_the_module_goes_through(error, rng):
    with pytest.raises(type(error)):
        policy(lambda x: raise_(error)).step(images(rng), 0, ())


def mean(x):
    return x.mean((1, 2, 3))


def bright(x):
    raise ValueError("too bright") if x.max() > 0.1 else RuntimeError("dark")


HIDDEN = {"recurrent": [(-1, 4)]}


@pytest.mark.parametrize(
    ("answer", "arguments", "message"),
    [
        (lambda x: {"control": x}, {}, "a dict; .*tensor"),
        (lambda x: (mean(x), None), {}, "a NoneType"),
        (lambda x: (), {}, "an empty tuple"),
        (lambda x: {}["key"], {}, "KeyError: 'key'; .*policy.preprocess"),
        (bright, {}, "ValueError: too bright"),
        (lambda x: x.mean(), {}, r"controls \(\) for 2 images"),
        (lambda x: x.mean((2, 3)), {}, r"controls \(2, 3\).*policy.output"),
        (lambda x: x.mean((2, 3)), {"action": Action(output=3)}, r"output \(is 3\)"),
        (lambda x: mean(x) / 0, {}, "inf for image 0"),
        (lambda x, h: (mean(x), h[:1]), HIDDEN, r"\[\(1, 4\)\] .* \[\(2,"),
        (lambda x, h: mean(x), HIDDEN, r"hidden states \[\]"),
        (lambda x: (mean(x), x), {}, r"\[\] .*policy.recurrent"),
        (lambda x: mean(x.detach()), {}, "no derivative"),
    ],
)
def test_wrong_answers_are_refused(answer, arguments, message, rng):
    with pytest.raises(InputError, match=f"(?s)mine.py: .*{message}"):
        made = policy(answer, **arguments)
        memory = made.initial_memory(2)
        made.step(images(rng), 0, memory)
        made.step_vjp(images(rng), 0, memory, mi.Float(1, 1), memory)


class Stateful(nn.Module):
    """Has a state in itself, which another answer or only a buffer shows."""

    def __init__(self, kind):
        super().__init__()
        self.kind, self.level = kind, None
        self.register_buffer("count", torch.zeros(()))

    def forward(self, image):
        level = mean(image)
        if self.kind == "level":
            self.level = level if self.level is None else 0.5 * self.level + level
            return self.level
        if self.kind == "count":
            self.count.add_(1)
            return level + torch.relu(self.count - 10)
        return mean(functional.dropout(image, 0.5, training=True))


@pytest.mark.parametrize(
    ("kind", "message"),
    [("level", "its controls"), ("random", "its controls"), ("count", "'count'")],
)
def test_modules_that_are_not_repeatable_are_refused(kind, message, rng):
    for mode, cotangents in (("step", ()), ("step_vjp", (mi.Float(1, 1), ()))):
        made, image = TorchPolicy(Stateful(kind), NoGoal(), name="a.py"), images(rng)
        with pytest.raises(InputError, match=f"a.py: .*{message}"):
            getattr(made, mode)(image, 0, (), *cotangents)


def test_the_check_is_made_once_and_minds_no_rounding(rng):
    calls = []

    def small(x):
        """A small difference of large sums, in single precision."""
        calls.append(len(x))
        return 1e-3 * (x[..., :4].sum((1, 2, 3)) - x[..., 4:].sum((1, 2, 3)))

    made = policy(small)
    for count in (2, 5, 1):
        made.step(images(rng, count), 0, ())
    assert calls == [2, 2, 1, 2] + [2, 5, 1]  # twice; alone and in a pair; the steps


def normalised(x):
    """Normalise by the statistics of the batch, without a buffer that would tell."""
    values = functional.batch_norm(x, None, None, training=True)
    return mean(values * torch.linspace(0, 1, x.shape[-1])) + x.mean()


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    ("answer", "arguments"),
    [
        (normalised, {}),
        (lambda x: mean(x) - 0.1 * x.mean(), {}),
        (lambda x, h: (mean(x) + x.sum() + h[0, :, 0], h), {"recurrent": [(1, -1, 4)]}),
    ],
)
def test_vehicles_that_influence_each_other_are_refused(answer, arguments, count, rng):
    made = policy(answer, **arguments)
    with pytest.raises(InputError, match="mine.py: .* in a batch "):
        made.step(images(rng, count), 0, made.initial_memory(count))


@pytest.mark.parametrize("output", [0, 1])
def test_a_network_may_drop_axes_of_one_image(output, rng):
    axes = (2, 3) if output else (1, 2, 3)
    made = policy(lambda x: x.mean(axes).squeeze(), action=Action(output, -2.0))
    image = images(rng, 1)
    column = image.numpy()[..., 1] if output else image.numpy()
    control, d_image = made.vjp(image, 0, mi.Float(1))
    np.testing.assert_allclose(control, [-2 * column.mean()], rtol=1e-6)
    np.testing.assert_allclose(d_image.numpy().sum(), -2, rtol=1e-5)


@pytest.mark.parametrize(
    ("line", "goal"),
    [("pass", NoGoal()), ("goals = 3", IntegerGoal(3)), ("goals = None", NoGoal())],
)
def test_a_module_says_how_it_takes_the_goal(line, goal, tmp_path):
    """One default, in Python and in scenarios; `batch` wraps the module."""
    code = f"import torch\n\n\nclass Net(torch.nn.Module):\n    {line}\n"
    (tmp_path / "net.py").write_text(code)
    file = {"file": "net.py:Net", "trust_code": True}
    made = [load_policy({**file, **extra}, tmp_path) for extra in ({}, {"batch": 1})]
    for policy in (*made, TorchPolicy(made[0].module)):
        assert policy.goal == goal
    chosen = load_policy({**file, "goal": {"kind": "none"}}, tmp_path)
    assert chosen.goal == TorchPolicy(made[0].module, NoGoal()).goal == NoGoal()
    module = nn.Module()
    module.goals = nn.Linear(3, 4)
    with pytest.raises(InputError, match=r"Module\.goals: a Linear"):
        TorchPolicy(module)


def test_several_controls_are_rows_and_go_back(rng):
    """Columns in any order, each with a scale; the derivative is autograd's."""
    weight = torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
    action = Action((2, 0), (2.0, -0.5))
    made = policy(lambda x: x.mean((2, 3)) @ weight, action=action)
    image = images(rng)
    rows = made.control(image, 0)
    means = torch.tensor(image.numpy().mean((1, 2)))
    expected = (means @ weight)[:, [2, 0]] * torch.tensor([2.0, -0.5])
    assert type(rows) is mi.ArrayXf and rows.shape == (2, 2)
    np.testing.assert_allclose(rows.numpy().T, expected.numpy(), rtol=1e-5)
    cotangent = mi.ArrayXf([1.0, 0.0], [0.0, 3.0])
    gradient = made.step_vjp(image, 0, (), cotangent, ())[0].numpy()
    by_mean = np.stack([2 * weight[:, 2].numpy(), -1.5 * weight[:, 0].numpy()])
    expected = np.broadcast_to(by_mean[:, None, None] / np.prod(SIZE), gradient.shape)
    np.testing.assert_allclose(gradient, expected, rtol=1e-5)
    with pytest.raises(InputError, match=r"output \(is \(3, 0\)\)"):
        policy(lambda x: x.mean((2, 3)), action=Action((3, 0))).control(image, 0)
