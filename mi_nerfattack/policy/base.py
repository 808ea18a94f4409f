"""Interface of a driving policy to the closed loop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mi_nerfattack.ranges import Positive, checked

#: What a policy carries from one control period to the next: arrays of its own kind.
Memory = tuple[Any, ...]


@dataclass(frozen=True)
@checked("numbers")
class Numbers:
    """Numbers that a policy gets besides images and goal: columns of a tensor (n, k).

    Args:
        speed: one column, metres per second along the heading.
        route_m: arc lengths, metres, from the route's point nearest to the vehicle to
            points ahead. Each point has two columns: its coordinates forward and to the
            left of the vehicle, metres (x1, y1, x2, y2, ...).
        time: one column, seconds since the start of the drive.
    """

    speed: bool = False
    route_m: tuple[Positive, ...] = ()
    time: bool = False

    def __bool__(self) -> bool:
        return self.size > 0

    @property
    def size(self) -> int:
        """Number k of columns."""
        return self.speed + 2 * len(self.route_m) + self.time

    @property
    def columns(self) -> dict[str, slice]:
        """Columns by name, in their order: speed, route, time."""
        sizes = {
            "speed": int(self.speed),
            "route": 2 * len(self.route_m),
            "time": int(self.time),
        }
        slices, start = {}, 0
        for name, size in sizes.items():
            if size:
                slices[name] = slice(start, start + size)
            start += size
        return slices


class AbstractPolicy(ABC):
    """Map from images to controls with a vector-Jacobian product.

    Images, numbers and controls are Dr.Jit arrays, so that the closed loop needs to
    know no other library. A call starts by waiting for the images. The closed loop
    calls `step` and its derivatives; those here are of policies without memory and
    without numbers.

    Attributes:
        differentiable: whether derivatives exist; gradient methods refuse others.
        numbers: the numbers that the policy gets besides images and goal.
    """

    differentiable: ClassVar[bool] = True
    numbers: Numbers = Numbers()

    def initial_memory(self, count: int) -> Memory:
        """Return the memory of `count` vehicles before their first image."""
        del count
        return ()

    def step(
        self, image: Any, goal: Any, memory: Memory, numbers: Any = None
    ) -> tuple[Any, Memory]:
        """Evaluate the policy and its next memory.

        Args:
            image: as for `control`.
            goal: as for `control`.
            memory: from `initial_memory` or the step before; left unchanged.
            numbers: tensor (n, k) of the columns of `Numbers`; None without.

        Returns:
            The control, as `control` gives it, and the memory for the next step.
        """
        del numbers
        return self.control(image, goal), memory

    def step_vjp(
        self,
        image: Any,
        goal: Any,
        memory: Memory,
        cotangent: Any,
        d_memory: Memory,
        numbers: Any = None,
    ) -> tuple[Any, Memory, Any]:
        """Multiply cotangents by the derivative of `step`.

        Args:
            image: as given to `step`. A policy without memory may get the images of
                several steps, one after the other, because the rows of a batch do not
                depend on each other.
            goal: as given to `step`.
            memory: as given to `step`.
            cotangent: derivative of the objective by the control, of its shape.
            d_memory: derivative of the objective by the memory that `step`
                returned, of its structure; ``()`` after the last step.
            numbers: as given to `step`.

        Returns:
            Derivatives of the objective by the image, by `memory` and by `numbers`;
            the last one is None where `numbers` is None.
        """
        del memory, d_memory, numbers
        return self.vjp(image, goal, cotangent)[1], (), None

    def planes(self, image: Any, memory: Memory) -> np.ndarray:
        """Return the planes that `step` makes of images before the network sees them.

        These are the images themselves, unless a policy overrides this method.

        Args:
            image: as for `control`.
            memory: as for `step`.

        Returns:
            (n, k, h, w), of the oldest frame first.
        """
        del memory
        return image.numpy().transpose(0, 3, 1, 2)

    @abstractmethod
    def control(self, image: Any, goal: Any) -> Any:
        """Evaluate the policy.

        Args:
            image: tensor (n, height, width, 3), sRGB in [0, 1]; taken as a constant.
            goal: an integer, or one for each image.

        Returns:
            Evaluated and detached, in the units of the vehicle's controls: a row (n,)
            of one control, k rows (k, n) of several.
        """

    @abstractmethod
    def vjp(self, image: Any, goal: Any, cotangent: Any) -> tuple[Any, Any]:
        """Multiply a cotangent by the derivative of `control`.

        Args:
            image: as for `control`.
            goal: as for `control`.
            cotangent: row (n,), derivative of the objective by the control.

        Returns:
            The control (n,), and the derivative of the objective by the image, a
            tensor of the image's shape; both evaluated and detached.
        """
