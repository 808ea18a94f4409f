"""The interface of experts: controllers that know the true state (appendix B.2)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np


class AbstractExpert(ABC):
    """Controller of vehicles on a route, one control period after the other.

    Attributes:
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
    """

    control_unit: ClassVar[str]

    @abstractmethod
    def control(self, states: Any) -> np.ndarray:
        """Compute the controls of the next period.

        Args:
            states: (n, m) or (m,), m >= 3: x, y (metres), heading (radians), others
                that are not read.

        Returns:
            (n,), positive to the left, clipped to the expert's limit.
        """

    def reset(self) -> None:
        """Forget former states, before a drive begins.

        Call it, too, before states are labelled that are not the next ones of the
        same vehicles. Most experts remember nothing.
        """
        return None
