"""Torch modules of users: strides, writing in place, exceptions, answers."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.goals import IntegerGoal, NoGoal
from mi_nerfattack.policy.one_image import OneImage
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.policy import load_policy

pytestmark = pytest.mark.usefixtures("variant")

SIZE = (6, 8)


class Wrap(nn.Module):
    """Call a function."""

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
    control, gradient = made.vjp(image, 0, mi.Float(1, 1))
    np.testing.assert_allclose(control, expected, atol=1e-4)
    assert np.any(gradient.numpy())


def test_networks_that_write_in_place_change_nothing_of_the_loop(rng):
    def halve(x, hidden):
        hidden.add_(1.0)
        return x.mul_(0.5).mean((1, 2, 3)), hidden

    made, image = policy(halve, recurrent=[(-1, 2)]), images(rng)
    before = image.numpy().copy()
    memory = made.initial_memory(2)
    for _ in range(2):
        control, after = made.step(image, 0, memory)
        d_image, _ = made.step_vjp(image, 0, memory, mi.Float(1, 1), ())
        np.testing.assert_array_equal(image.numpy(), before)
        assert not memory[0].any() and bool((after[0] == 1).all())
        np.testing.assert_allclose(control, 0.5 * before.mean((1, 2, 3)), rtol=1e-5)
        np.testing.assert_allclose(d_image.numpy(), 0.5 / before[0].size, rtol=1e-5)


def raise_(error):
    raise error


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: {"control": x}, "returns a dict; the control as a tensor"),
        (lambda x: None, "returns a NoneType"),
        (lambda x: (x.mean((1, 2, 3)), None), "returns a NoneType"),
        (lambda x: (), "returns an empty tuple"),
        (lambda x: x.nothing, "shape .2, 3, 6, 8.*AttributeError: .*'nothing'"),
        (lambda x: {}["key"], "KeyError: 'key'; declare policy.preprocess"),
        (lambda x: raise_(AssertionError("Guard failed")), "AssertionError: Guard f"),
        (lambda x: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_modules_that_fail_are_told(function, message, rng):
    with pytest.raises(InputError, match=f"(?s)mine.py: .*{message}"):
        policy(function).step(images(rng), 0, ())


@pytest.mark.parametrize("error", [MemoryError(), KeyboardInterrupt()])
def test_what_is_no_fault_of_the_module_goes_through(error, rng):
    with pytest.raises(type(error)):
        policy(lambda x: raise_(error)).step(images(rng), 0, ())


class Counting(nn.Module):
    """Keeps a state in itself."""

    def __init__(self):
        super().__init__()
        self.level = None

    def forward(self, image):
        mean = image.mean((1, 2, 3))
        self.level = mean if self.level is None else 0.5 * (self.level + 2 * mean)
        return self.level


class Buffered(nn.Module):
    """Changes a buffer that no answer shows yet."""

    def __init__(self):
        super().__init__()
        self.register_buffer("count", torch.zeros(()))

    def forward(self, image):
        self.count.add_(1)
        return image.mean((1, 2, 3)) + torch.relu(self.count - 10)


class Random(nn.Module):
    def forward(self, image):
        return nn.functional.dropout(image, 0.5, training=True).mean((1, 2, 3))


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (Counting, "its controls are"),
        (Random, "its controls are"),
        (Buffered, "its buffer 'count' changes"),
    ],
)
@pytest.mark.parametrize("mode", ["step", "step_vjp"])
def test_modules_that_are_not_repeatable_are_refused(module, message, mode, rng):
    made, image = TorchPolicy(module(), NoGoal(), name="mine.py"), images(rng)
    rest = {"step": (), "step_vjp": (mi.Float(1, 1), ())}
    with pytest.raises(InputError, match=f"mine.py: .*{message}.*training mode.*recur"):
        getattr(made, mode)(image, 0, (), *rest[mode])


def test_the_check_is_made_once(rng):
    calls = []

    def mean(x):
        calls.append(len(x))
        return x.mean((1, 2, 3))

    made = policy(mean)
    for _ in range(3):
        made.step(images(rng), 0, ())
    assert len(calls) == 2 + 3


def test_a_second_output_of_one_image_is_not_dropped(rng):
    module = Wrap(lambda x: (x.mean((1, 2, 3)), x.mean((1, 2, 3))))
    with pytest.raises(InputError, match="policy.recurrent.*policy.output"):
        TorchPolicy(OneImage(module), NoGoal()).step(images(rng), 0, ())


@pytest.mark.parametrize(
    ("answer", "arguments", "message"),
    [
        (lambda x: x.mean(), {}, r"controls \(\) for 2 images"),
        (lambda x: x.mean((2, 3)), {}, r"controls \(2, 3\).*policy.output"),
        (lambda x: x.mean((2, 3)), {"output": 3}, r"output \(is 3\)"),
        (lambda x: x[:1].mean((1, 2, 3)), {}, r"\(1,\) for 2 images"),
        (lambda x: x.mean((1, 2, 3)) / 0, {}, "mine.py: control inf for image 0"),
        (
            lambda x: x.reshape(7),
            {},
            r"mine.py: fails on an input of shape \(2, 3, 6, 8\)",
        ),
        (lambda x, h: x.mean((1, 2, 3)), {}, "mine.py: fails.*argument"),
        (
            lambda x, h: (x.mean((1, 2, 3)), h[:1]),
            {"recurrent": [(-1, 4)]},
            r"\[\(1, 4\)\] come out where \[\(2, 4\)\]",
        ),
        (
            lambda x, h: x.mean((1, 2, 3)),
            {"recurrent": [(-1, 4)]},
            r"hidden states \[\] come out",
        ),
        (
            lambda x: (x.mean((1, 2, 3)), x),
            {},
            r"come out where \[\] went in.*policy.recurrent",
        ),
    ],
)
def test_wrong_answers_are_refused(answer, arguments, message, rng):
    with pytest.raises(InputError, match=message):
        made = policy(answer, **arguments)
        made.step(images(rng), 0, made.initial_memory(2))


def test_column_scale_and_sign():
    by_column = torch.tensor([1.0, 2.0, 3.0])
    made = policy(lambda x: x.mean((2, 3)) * by_column, output=2, control_scale=-2.0)
    image = mi.TensorXf(np.full((2, *SIZE, 3), 0.5, "f4"))
    np.testing.assert_allclose(made.control(image, 0), -3.0)


def test_a_module_that_detaches_the_image_is_refused(rng):
    made = policy(lambda x: x.detach().mean((1, 2, 3)))
    with pytest.raises(InputError, match="mine.py: its control has no derivative"):
        made.step_vjp(images(rng, 1), 0, (), mi.Float(1), ())


@pytest.mark.parametrize(
    ("line", "goal"),
    [("pass", NoGoal()), ("goals = 3", IntegerGoal(3)), ("goals = None", NoGoal())],
)
def test_a_module_says_how_it_takes_the_goal(line, goal, tmp_path):
    """One default, in Python and in scenarios; `batch` wraps the module."""
    code = f"import torch\n\n\nclass Net(torch.nn.Module):\n    {line}\n"
    (tmp_path / "net.py").write_text(code)
    file = {"file": "net.py:Net", "trust_code": True}
    made = [load_policy({**file, **more}, tmp_path) for more in ({}, {"batch": 1})]
    for policy in (*made, TorchPolicy(made[0].module)):
        assert policy.goal == goal
    chosen = load_policy({**file, "goal": "none"}, tmp_path)
    assert chosen.goal == TorchPolicy(made[0].module, NoGoal()).goal == NoGoal()


def test_goals_that_are_no_number_are_refused():
    module = nn.Module()
    module.goals = nn.Linear(3, 4)
    with pytest.raises(InputError, match=r"Module\.goals: a Linear; .*goal=NoGoal"):
        TorchPolicy(module)
    assert TorchPolicy(module, NoGoal()).goal == NoGoal()
