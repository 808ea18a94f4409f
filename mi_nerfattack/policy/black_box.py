"""Policies without derivatives: Python callables, and the family's common part."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NoReturn

import numpy as np
import torch

from mi_nerfattack.backend.torch_arrays import to_controls, to_torch
from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.policy.base import AbstractPolicy, Memory
from mi_nerfattack.policy.checks import (
    Output,
    Scale,
    check_images,
    chosen_controls,
    expand_goals,
    scaled,
)
from mi_nerfattack.policy.preprocess import Preprocess

DIFFERENTIABLE_KINDS = "pilotnet, module, exported, torchscript, onnx, drjit"


class AbstractBlackBox(AbstractPolicy):
    """Policy that only answers: no gradient method takes it.

    Its memory is the number of images before this one, and the frame stack. A policy
    that keeps more than that itself starts anew where that number is 0.

    Args:
        preprocess: from the camera's image to the policy's.
        control_scale: factor from the policy's unit and sign to the vehicle's; one,
            or one for each control.
        output: column of the control, needed where there are several; of a vehicle
            with several controls the columns of these.
        name: for messages.
    """

    differentiable: ClassVar[bool] = False

    def __init__(
        self,
        name: str,
        preprocess: Preprocess | None = None,
        control_scale: Scale = 1.0,
        output: Output = None,
    ) -> None:
        self.name = name
        self.preprocess: Preprocess = preprocess or Preprocess()
        self.control_scale: Scale = control_scale
        self.output: Output = output

    @abstractmethod
    def answer(self, image: np.ndarray, goals: np.ndarray, step: int) -> np.ndarray:
        """Ask the policy.

        Args:
            image: what the pre-processing gives, float32, (n, c, h, w) by default.
            goals: (n,) int64.
            step: number of images before this one in the drive.

        Returns:
            (n,), (n, 1), or (n, k) numbers.
        """

    def initial_memory(self, count: int) -> Memory:
        """Return step 0 and an empty frame stack."""
        return 0, torch.zeros(count, 0, 0, 0, 0)

    def step(self, image: Any, goal: Any, memory: Memory) -> tuple[Any, Memory]:
        """Pre-process the images on the CPU and ask."""
        images = to_torch(image)
        check_images(images)
        step, past = memory
        with torch.no_grad():
            planes = self.preprocess.transform(images.to("cpu", torch.float32))
            seen, past = self.preprocess.stack(planes, past)
            goals = expand_goals(goal, planes).numpy().copy()
            # a copy: functions may write into their image
            given = np.array(seen.numpy(), order="C")
            answer = self.answer(given, goals, step)
            values = torch.from_numpy(np.array(answer, np.float64))
            control = chosen_controls(values, len(images), self.output, self.name)
        scaled_control = scaled(control, self.control_scale)
        return to_controls(scaled_control, image), (step + 1, past)

    def planes(self, image: Any, memory: Memory) -> np.ndarray:
        """Return the stack of pre-processed frames, whatever their layout."""
        images = to_torch(image).to("cpu", torch.float32)
        return self.preprocess.planes(images, memory[1])

    def control(self, image: Any, goal: Any) -> Any:
        """Ask about first images."""
        return self.step(image, goal, self.initial_memory(len(image)))[0]

    def vjp(self, image: Any, goal: Any, cotangent: Any) -> NoReturn:
        """Raise InputError."""
        self._refuse()

    def step_vjp(
        self, image: Any, goal: Any, memory: Memory, cotangent: Any, d_memory: Memory
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
            them and returns an array, or a list of numbers.
        name: for messages; the others as for `AbstractBlackBox`.
    """

    def __init__(
        self,
        function: Callable[[np.ndarray, np.ndarray, int], Any],
        name: str,
        preprocess: Preprocess | None = None,
        control_scale: Scale = 1.0,
        output: Output = None,
    ) -> None:
        self.function = function
        AbstractBlackBox.__init__(self, name, preprocess, control_scale, output)

    def answer(self, image: np.ndarray, goals: np.ndarray, step: int) -> np.ndarray:
        """Call the function."""
        try:
            return np.asarray(self.function(image, goals, step), np.float64)
        except Exception as err:  # a user's function raises whatever it likes
            if is_interrupt(err):
                raise
            raise InputError(
                f"{self.name}: raises {type(err).__name__} on an image of shape "
                f"{image.shape}: {err}"
            ) from err
