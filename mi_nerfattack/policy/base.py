"""Interface of a driving policy to the closed loop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

#: What a policy carries from one control period to the next: arrays of its own kind.
Memory = tuple[Any, ...]


class AbstractPolicy(ABC):
    """Map from images to controls with a vector-Jacobian product.

    Images and controls are Dr.Jit arrays, so that the closed loop needs to know no
    other library. A call starts by waiting for the images. The closed loop calls
    `step` and its derivatives; those here are of policies without memory.

    Attributes:
        differentiable: whether derivatives exist; gradient methods refuse others.
    """

    differentiable: ClassVar[bool] = True

    def initial_memory(self, count: int) -> Memory:
        """Return the memory of `count` vehicles before their first image."""
        del count
        return ()

    def step(self, image: Any, goal: Any, memory: Memory) -> tuple[Any, Memory]:
        """Evaluate the policy and its next memory.

        Args:
            image: as for `control`.
            goal: as for `control`.
            memory: from `initial_memory` or the step before; left unchanged.

        Returns:
            The control, as `control` gives it, and the memory for the next step.
        """
        return self.control(image, goal), memory

    def step_vjp(
        self, image: Any, goal: Any, memory: Memory, cotangent: Any, d_memory: Memory
    ) -> tuple[Any, Memory]:
        """Multiply cotangents by the derivative of `step`.

        Args:
            image: as given to `step`; of a policy without memory, images of several
                steps one after the other: each row of a batch stands for itself.
            goal: as given to `step`.
            memory: likewise.
            cotangent: (n,) or (k, n), derivative of the objective by the control.
            d_memory: derivative of the objective by the memory that `step`
                returned, of its structure; ``()`` after the last step.

        Returns:
            Derivatives of the objective by the image and by `memory`.
        """
        del memory, d_memory
        return self.vjp(image, goal, cotangent)[1], ()

    def planes(self, image: Any, memory: Memory) -> np.ndarray:
        """Return what `step` makes of images before it looks at them.

        The images themselves, unless a policy tells more.

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
            The control of each image, a row (n,), in the unit of the vehicle's; of a
            vehicle with k > 1 controls an array of k rows (k, n), such as `ArrayXf`.
            Evaluated and detached.
        """

    @abstractmethod
    def vjp(self, image: Any, goal: Any, cotangent: Any) -> tuple[Any, Any]:
        """Multiply a cotangent by the derivative of `control`.

        Args:
            image: as for `control`.
            goal: as for `control`.
            cotangent: (n,) or (k, n), derivative of the objective by the control.

        Returns:
            The control, and the derivative of the objective by the image, a
            tensor of the image's shape; both evaluated and detached.
        """
