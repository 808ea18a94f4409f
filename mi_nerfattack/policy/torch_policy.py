"""Policies that are modules of torch, with their derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch

from mi_nerfattack.backend.torch_arrays import to_controls, to_tensor, to_torch
from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.base import AbstractPolicy, Memory, Numbers
from mi_nerfattack.policy.checks import (
    check_alone,
    check_hidden,
    check_images,
    check_repeatable,
    expand_goals,
    misfit,
    usual_shape,
)
from mi_nerfattack.policy.inputs import (
    GOAL,
    AbstractGoal,
    Inputs,
    NoGoal,
    declared_goal,
)
from mi_nerfattack.policy.one_image import OneImage
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.preprocess import Preprocess


def call_module(
    module: torch.nn.Module, name: str, *arguments: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Call a module with tensors of its own, and check what it returns.

    The camera's image is a view of memory that the loop reads again, and has the
    strides of (n, h, w, 3). A foreign network may write into its input, or view it
    as the contiguous array of its training, so it gets copies. `PilotNet` does neither,
    and convolves the view without a copy.

    Args:
        module: is called as ``module(*arguments)``.
        name: for messages.
        arguments: image, goal, and hidden states.

    Returns:
        The control and the hidden states.

    Raises:
        InputError: the module raises an exception, or returns something else than
            tensors. If it takes images of another shape, the message names the shape.
    """
    try:
        if isinstance(module, PilotNet):
            result = module(*arguments)
        else:
            result = module(*(a.clone(memory_format=_PLAIN) for a in arguments))
    except (InputError, torch.OutOfMemoryError, MemoryError):
        raise
    except Exception as err:  # a user's module raises whatever it likes
        if is_interrupt(err):
            raise
        shapes = [tuple(part.shape) for part in arguments]
        expected = usual_shape(module, arguments[0], arguments[1:])
        if expected not in (None, shapes[0]):
            raise InputError(f"{name}: {misfit(expected, shapes[0])}") from err
        raise InputError(
            f"{name}: fails on an input of shape {shapes[0]}, with further "
            f"inputs of shapes {shapes[1:]}: {type(err).__name__}: {err}; declare "
            "policy.preprocess, inputs, goal and recurrent as the network needs them"
        ) from err
    return _tensors(result, name)


def _tensors(result: Any, name: str) -> tuple[torch.Tensor, ...]:
    """Take a tensor, or a tuple or list of them, and nothing else."""
    tensors = tuple(result) if isinstance(result, (tuple, list)) else (result,)
    wrong = [type(p).__name__ for p in tensors if not isinstance(p, torch.Tensor)]
    if wrong or not tensors:
        raise InputError(
            f"{name}: returns {f'a {wrong[0]}' if wrong else 'an empty tuple'}; the "
            "control as a tensor, or a tuple of it and the hidden states, is needed"
        )
    return tensors


_PLAIN = torch.contiguous_format


class TorchPolicy(AbstractPolicy):
    """Policy given by a torch module; memory is shared, not copied, both ways.

    The module is called as ``module(image, *goal, *hidden)``, or with the inputs that
    `inputs` names before the hidden states. It returns the control, or a tuple of the
    control and the hidden states for the next image. The module keeps no state in
    itself; the policy evaluates the very first image twice to check that. The memory is
    the frame stack of each image, where there is one, and the hidden states.

    Args:
        module: takes the image as `preprocess` gives it, by default (n, 3, height,
            width), sRGB in [0, 1], and the goal as `goal` gives it. It returns numbers
            (n,), (n, 1) or (n, k), of which `action` makes the control. The policy
            switches it to evaluation mode, freezes its parameters and moves it to the
            device of the images.
        goal: form in which the module gets the goal; by default
            ``IntegerGoal(module.goals)`` if the module has this attribute, otherwise
            `NoGoal()`.
        preprocess: from the camera's image to the network's.
        recurrent: shapes of the hidden states, zero at first, with -1 for the number
            of vehicles: ``[(-1, 64)]``, ``[(1, -1, 32)]``.
        action: what the answer means; by default it is the control.
        inputs: what the module takes besides the hidden states, in its order.
        name: for messages; the module's class unless given.
    """

    def __init__(
        self,
        module: torch.nn.Module,
        goal: AbstractGoal | None = None,
        preprocess: Preprocess | None = None,
        recurrent: Sequence[Sequence[int]] = (),
        action: Action | None = None,
        inputs: Inputs | None = None,
        name: str | None = None,
    ) -> None:
        self.module: torch.nn.Module = module.eval()
        for parameter in module.parameters():  # a ScriptModule has no requires_grad_
            parameter.requires_grad_(False)
        self.goal: AbstractGoal = goal or declared_goal(module)
        self.preprocess: Preprocess = preprocess or Preprocess()
        self.recurrent: tuple[tuple[int, ...], ...] = check_hidden(recurrent)
        self.action: Action = action or Action()
        self.inputs: Inputs = inputs or Inputs()
        has_goal, names = not isinstance(self.goal, NoGoal), self.inputs.names
        if names and has_goal != (GOAL in names):
            raise InputError(
                f"{name or type(module).__name__}: policy.goal is {self.goal!r}, and "
                f"policy.inputs has {', '.join(names)}; let both have a goal, or none"
            )
        self.numbers: Numbers = self.inputs.numbers
        self.name: str = name or type(module).__name__
        self._checked = False
        self._device: torch.device | None = None  # of the images that it saw last

    def __repr__(self) -> str:
        return f"TorchPolicy({self.name}, {self.goal!r})"

    def control(self, image: Any, goal: Any) -> Any:
        """Evaluate the module on first images, without recording a graph."""
        return self.step(image, goal, self.initial_memory(len(image)))[0]

    def vjp(self, image: Any, goal: Any, cotangent: Any) -> tuple[Any, Any]:
        """Evaluate the module and its reverse derivative on first images."""
        memory = self.initial_memory(len(image))
        control, (d_image, *_) = self._pull_back(
            image, goal, memory, cotangent=cotangent, d_memory=()
        )
        return to_controls(control, image), to_tensor(d_image, image)

    def initial_memory(self, count: int) -> Memory:
        """Return empty frame stacks, where there are any, and zeros."""
        like = self._precision()
        stacks = (
            torch.zeros(count, 0, 0, 0, 0, dtype=like) for _ in range(self._stacks)
        )
        hidden = (
            torch.zeros([count if size < 0 else size for size in shape], dtype=like)
            for shape in self.recurrent
        )
        return (*stacks, *hidden)

    def step(
        self, image: Any, goal: Any, memory: Memory, numbers: Any = None
    ) -> tuple[Any, Memory]:
        """Evaluate the module without recording a graph."""
        rows = None if numbers is None else to_torch(numbers)
        self._check(image, goal, memory, rows)
        with torch.no_grad():
            control, after = self._evaluate(to_torch(image), goal, memory, rows)
        return to_controls(control, image), after

    def planes(self, image: Any, memory: Memory) -> np.ndarray:
        """Return the stacks of pre-processed frames, whatever their layout.

        Those of the first image, where the network takes several.
        """
        images = to_torch(image)
        images = images.to(self._precision() or images.dtype)
        first, *_ = self.inputs.pictures(images).values()
        return self.preprocess.planes(first, self._past(first, memory, 0))

    def step_vjp(
        self,
        image: Any,
        goal: Any,
        memory: Memory,
        cotangent: Any,
        d_memory: Memory,
        numbers: Any = None,
    ) -> tuple[Any, Memory, Any]:
        """Evaluate the module again and its reverse derivative, one graph at a time."""
        _, (d_image, *gradients) = self._pull_back(
            image, goal, memory, cotangent=cotangent, d_memory=d_memory, numbers=numbers
        )
        d_image = to_tensor(d_image, image)
        if numbers is None:
            return d_image, tuple(gradients), None
        *d_before, d_numbers = gradients
        return d_image, tuple(d_before), to_tensor(d_numbers, numbers)

    def _pull_back(
        self,
        image: Any,
        goal: Any,
        memory: Memory,
        cotangent: Any,
        d_memory: Memory,
        numbers: Any = None,
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """Return the control, and derivatives by image, memory parts and numbers."""
        rows = () if numbers is None else (to_torch(numbers),)
        self._check(image, goal, memory, *rows)
        inputs = (to_torch(image), *memory, *rows)
        leaves = [part.detach().requires_grad_(True) for part in inputs]
        end = 1 + len(memory)
        with torch.enable_grad(), self._plain_layers():
            control, after = self._evaluate(
                leaves[0], goal, tuple(leaves[1:end]), *leaves[end:]
            )
        weight = to_torch(cotangent).to(control)
        weight = weight if weight.ndim == 1 else weight.T
        if weight.shape != control.shape:
            raise InputError(
                f"cotangent: {tuple(weight.shape)} for {tuple(control.shape)} controls"
            )
        weights = (weight, *(d_memory or map(torch.zeros_like, after)))
        pairs = zip((control, *after), weights, strict=True)
        used = [(value, weight) for value, weight in pairs if value.requires_grad]
        gradients: Sequence[torch.Tensor | None] = [None]
        if used:
            values, weights = zip(*used, strict=True)
            gradients = torch.autograd.grad(values, leaves, weights, allow_unused=True)
        if gradients[0] is None:
            raise InputError(
                f"{self.name}: its control has no derivative by the image; it must "
                "not detach the image or leave torch"
            )
        filled = [
            torch.zeros_like(leaf) if gradient is None else gradient
            for leaf, gradient in zip(leaves, gradients, strict=True)
        ]
        return control, tuple(filled)

    def _check(
        self, image: Any, goal: Any, memory: Memory, numbers: torch.Tensor | None = None
    ) -> None:
        """Evaluate the very first image twice, alone, and with a darker one.

        A state in the module and batch statistics show themselves.
        """
        if not self._checked:
            images = to_torch(image)

            def again() -> torch.Tensor:
                return self._evaluate(images, goal, memory, numbers)[0]

            check_repeatable(self.module, again, self.name)
            if not isinstance(self.module, PilotNet | OneImage):
                goals = expand_goals(goal, images)[:1]
                pair = torch.cat([images[:1], 0.25 * images[:1]])
                one = None if numbers is None else numbers[:1]
                first_states = [
                    (part.narrow(axis, 0, 1), axis)
                    for part, axis in zip(memory, self._axes(), strict=True)
                ]

                def evaluate(count: int) -> torch.Tensor:
                    hidden = (
                        torch.cat([part] * count, axis) for part, axis in first_states
                    )
                    rows = None if one is None else one.expand(count, -1)
                    several = goals.expand(count)
                    return self._evaluate(pair[:count], several, tuple(hidden), rows)[0]

                scale = self.action.scale
                largest = max(map(abs, scale if isinstance(scale, tuple) else (scale,)))
                check_alone(evaluate, self.name, 1e-6 * largest)
            self._checked = True

    @property
    def _stacks(self) -> int:
        """Number of frame stacks in the memory."""
        return len(self.inputs.images) if self.preprocess.history else 0

    def _axes(self) -> list[int]:
        """Return the axis of the vehicles in each part of the memory."""
        return [0] * self._stacks + [shape.index(-1) for shape in self.recurrent]

    def _evaluate(
        self,
        image: torch.Tensor,
        goal: Any,
        memory: Memory,
        numbers: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, Memory]:
        """Apply the module to (n, height, width, 3), in the module's precision."""
        check_images(image)
        if image.device != self._device:  # listing all tensors takes half a millisecond
            if any(part.device != image.device for part in self._tensors()):
                self.module.to(image.device)
            self._device = image.device
        image = image.to(self._precision() or image.dtype)
        memory = tuple(part.to(image) for part in memory)
        numbers = None if numbers is None else numbers.to(image)
        # Images, of each camera its own stack of frames
        frames, stacks = {}, []
        for index, (name, picture) in enumerate(self.inputs.pictures(image).items()):
            planes = self.preprocess.transform(picture)
            past = self._past(planes, memory, index)
            frames[name], past = self.preprocess.stack(planes, past)
            stacks.append(past)
        stacks, hidden = stacks[: self._stacks], memory[self._stacks :]
        # Network
        goals = self.goal.arguments(expand_goals(goal, image), image)
        arguments = self.inputs.arguments(frames, goals, numbers)
        outputs = call_module(self.module, self.name, *arguments, *hidden)
        # Controls
        speed = None
        if self.action.needs_speed:
            speed = self.inputs.by_name(numbers)["speed"][:, 0]
        control = self.action.controls(outputs[0], len(image), speed, self.name)
        after = outputs[1:]
        shapes = [tuple(part.shape) for part in after]
        if shapes != [tuple(part.shape) for part in hidden]:
            raise InputError(
                f"{self.name}: hidden states {shapes} come out where "
                f"{[tuple(part.shape) for part in hidden]} went in; declare their "
                "shapes as policy.recurrent, or return several controls as one tensor "
                "(n, k) and tell the column by policy.output"
            )
        return control, (*stacks, *after)

    def _past(self, like: torch.Tensor, memory: Memory, index: int) -> torch.Tensor:
        """Return earlier frames of a stack; none where there is no stack."""
        return memory[index] if self.preprocess.history else like.new_zeros(0, 0)

    def _plain_layers(self) -> AbstractContextManager[None]:
        """Switch cuDNN off for recurrent layers: it differentiates none in evaluation.

        Programs do not show their layers; hidden states betray them.
        """
        layers = self.module.modules()
        if self.recurrent or any(isinstance(m, torch.nn.RNNBase) for m in layers):
            return torch.backends.cudnn.flags(enabled=False)
        return nullcontext()

    def _precision(self) -> torch.dtype | None:
        """Return the type of the module's parameters and buffers, if it has any."""
        tensors = (t for t in self._tensors() if t.is_floating_point())
        return next((t.dtype for t in tensors), None)

    def _tensors(self) -> Iterator[torch.Tensor]:
        """Yield the module's parameters and buffers."""
        yield from self.module.parameters()
        yield from self.module.buffers()
