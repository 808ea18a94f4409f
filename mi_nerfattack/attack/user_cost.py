"""A user's own cost of the vehicle's state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.errors import InputError


@dataclass(frozen=True, eq=False)
class UserCost:
    """A function of the state, whose result is checked.

    Attributes:
        name: of the function, for messages.
        function: maps states (m, k) of k vehicles and times to costs (k,), which the
            attack minimises. The rows of the states are px, py (metres), theta
            (radians) and those that the dynamics add. The function takes and returns
            Dr.Jit arrays in double precision. The k states are independent.
    """

    name: str
    function: Callable[[Any], Any]

    def __call__(self, state: Any) -> Any:
        """Evaluate at states (m, k): (k,).

        Raises:
            InputError: the function returned something else.
        """
        value, row = self.function(state), type(state[0])
        real = dr.is_array_v(value) and dr.is_float_v(value)
        if not real or dr.depth_v(value) != 1 or dr.is_tensor_v(value):
            raise InputError(
                f"{self.name}: returned {type(value).__name__}; must return a Dr.Jit "
                f"row such as {row.__name__}, one number a column of the state"
            )
        if dr.width(value) != dr.width(state):
            raise InputError(
                f"{self.name}: returned {dr.width(value)} numbers for "
                f"{dr.width(state)} states; must return one a column of the state"
            )
        return row(value)

    def check(self, states: Any) -> None:
        """Try the function and its derivative.

        Args:
            states: (m, k), k >= 2, where the function must be differentiable.

        Raises:
            InputError: values or derivatives are not finite, do not depend on the
                state by Dr.Jit operations, or mix columns.
        """
        leaf, count = type(states)(states), dr.width(states)
        dr.enable_grad(leaf)
        value = self(leaf)
        if not np.isfinite(dr.detach(value).numpy()).all():
            raise InputError(f"{self.name}: is not finite at {_text(states)}")
        if not dr.grad_enabled(value):
            raise InputError(
                f"{self.name}: has no derivative by the state; compute with Dr.Jit "
                "operations (drjit.sin, not numpy.sin) and without detaching"
            )
        first = np.arange(count) == 0
        dr.backward(dr.sum(value * type(value)(first.astype(np.float64))))
        gradient = dr.grad(leaf).numpy()
        if not np.isfinite(gradient).all():
            raise InputError(
                f"{self.name}: derivative is not finite at {_text(states)}"
            )
        if gradient[:, ~first].any():
            raise InputError(
                f"{self.name}: the cost of one column depends on another; columns are "
                "different vehicles and times, and independent"
            )


def _text(states: Any) -> str:
    return f"states {np.round(dr.detach(states).numpy().T, 3).tolist()}"
