"""Policies without derivatives: Python callables, and the family's common part."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NoReturn

import numpy as np
import torch

from mi_nerfattack.backend.torch_arrays import to_controls, to_torch
from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.base import AbstractPolicy, Memory, Numbers
from mi_nerfattack.policy.checks import check_images, expand_goals
from mi_nerfattack.policy.inputs import GOAL, Inputs
from mi_nerfattack.policy.preprocess import Preprocess

DIFFERENTIABLE_KINDS = "pilotnet, module, exported, torchscript, onnx, openpilot, drjit"


class AbstractBlackBox(AbstractPolicy):
    """Policy that only answers: no gradient method takes it.

    Its memory is the number of images before this one, and the frame stack of each
    camera. A policy that keeps a further memory itself clears it where this number
    is 0.

    Args:
        preprocess: from the camera's image to the policy's.
        action: meaning of the answer; by default the answer is the control.
        inputs: the inputs of the policy.
        name: for messages.
    """

    differentiable: ClassVar[bool] = False

    def __init__(
        self,
        name: str,
        preprocess: Preprocess | None = None,
        action: Action | None = None,
        inputs: Inputs | None = None,
    ) -> None:
        self.name = name
        self.preprocess: Preprocess = preprocess or Preprocess()
        self.action: Action = action or Action()
        self.inputs: Inputs = inputs or Inputs()
        self.numbers: Numbers = self.inputs.numbers

    @abstractmethod
    def answer(
        self, arrays: Mapping[str, np.ndarray], goals: np.ndarray, step: int
    ) -> np.ndarray:
        """Ask the policy.

        Args:
            arrays: inputs by name: images as the pre-processing gives them, float32,
                (n, c, h, w) by default, and the numbers that the policy asks for.
            goals: (n,) int64.
            step: number of images before these in the drive.

        Returns:
            (n,), (n, 1), or (n, k) numbers, or positions.
        """

    def initial_memory(self, count: int) -> Memory:
        """Return step 0 and empty frame stacks."""
        return 0, *(torch.zeros(count, 0, 0, 0, 0) for _ in self.inputs.images)

    def step(
        self, image: Any, goal: Any, memory: Memory, numbers: Any = None
    ) -> tuple[Any, Memory]:
        """Pre-process the images on the CPU and ask."""
        images = to_torch(image).to("cpu", torch.float32)
        check_images(images)
        rows = None if numbers is None else to_torch(numbers).to("cpu", torch.float32)
        arrays, stacks = {}, []
        with torch.no_grad():
            pictures = self.inputs.pictures(images).items()
            for (name, picture), past in zip(pictures, memory[1:], strict=True):
                planes = self.preprocess.transform(picture)
                frames, past = self.preprocess.stack(planes, past)
                # a copy: functions may write into their image
                arrays[name] = np.array(frames.numpy(), order="C")
                stacks.append(past)
            numbers_by_name = self.inputs.by_name(rows)
            arrays |= {key: np.array(v.numpy()) for key, v in numbers_by_name.items()}
            goals = expand_goals(goal, images).numpy().copy()
            answer = self.answer(arrays, goals, memory[0])
            values = torch.from_numpy(np.array(answer, np.float64))
            speed = None
            if self.action.needs_speed:
                speed = numbers_by_name["speed"][:, 0].double()
            control = self.action.controls(values, len(images), speed, self.name)
        return to_controls(control, image), (memory[0] + 1, *stacks)

    def planes(self, image: Any, memory: Memory) -> np.ndarray:
        """Return the stack of pre-processed frames of the first image."""
        images = to_torch(image).to("cpu", torch.float32)
        first, *_ = self.inputs.pictures(images).values()
        return self.preprocess.planes(first, memory[1])

    def control(self, image: Any, goal: Any) -> Any:
        """Ask about first images."""
        return self.step(image, goal, self.initial_memory(len(image)))[0]

    def vjp(self, image: Any, goal: Any, cotangent: Any) -> NoReturn:
        """Raise InputError."""
        self._refuse()

    def step_vjp(
        self,
        image: Any,
        goal: Any,
        memory: Memory,
        cotangent: Any,
        d_memory: Memory,
        numbers: Any = None,
    ) -> NoReturn:
        """Raise InputError."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise InputError(
            f"{self.name}: is a black box, which has no derivatives; policies of the "
            f"kinds {DIFFERENTIABLE_KINDS} have"
        )


class CallablePolicy(AbstractBlackBox):
    """Python function ``function(image, goal, step)`` of NumPy arrays.

    Args:
        function: gets image, goals and step as `AbstractBlackBox.answer` describes
            them and returns an array, or a list of numbers. Where `inputs` names what
            the policy is given, it is called with these arrays in that order, then
            with the step.
        name: for messages; the others as for `AbstractBlackBox`.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        name: str,
        preprocess: Preprocess | None = None,
        action: Action | None = None,
        inputs: Inputs | None = None,
    ) -> None:
        self.function = function
        AbstractBlackBox.__init__(self, name, preprocess, action, inputs)

    def answer(
        self, arrays: Mapping[str, np.ndarray], goals: np.ndarray, step: int
    ) -> np.ndarray:
        """Call the function."""
        every = {**arrays, GOAL: goals}
        names = self.inputs.names or (*self.inputs.images, GOAL)
        arguments = [every[name] for name in names]
        try:
            return np.asarray(self.function(*arguments, step), np.float64)
        except Exception as err:  # a user's function raises whatever it likes
            if is_interrupt(err):
                raise
            shapes = {name: every[name].shape for name in names}
            raise InputError(
                f"{self.name}: raises {type(err).__name__} on arrays of the shapes "
                f"{shapes}: {err}"
            ) from err
