"""The user's own vehicle model, given as a function in Dr.Jit operations."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import numpy as np
from pydantic import Field

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.ranges import Count, Positive, checked
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, soft_limit


@dataclass(frozen=True)
@checked("{self.__class__.__name__}")
class AbstractUserDynamics(AbstractDynamics):
    """Vehicle model given as a function, with what describes its state and control."""

    function: Callable[[Any, Any], Any]
    size: Annotated[int, Field(ge=3)] = 3
    limit: Positive | tuple[Positive, ...] = 1.0
    rest_state: tuple[float, ...] = ()
    controls: Count = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "control_names", user_controls(self.controls))
        if isinstance(self.limit, tuple) and len(self.limit) != self.controls:
            raise InputError(
                f"{type(self).__name__}.limit: {self.limit!r}; one number, or "
                f"{self.controls} numbers, one for each control"
            )
        n_extra = self.size - 3
        if (
            len(self.rest_state) not in (0, n_extra)
            or not np.isfinite(self.rest_state).all()
        ):
            raise InputError(
                f"{type(self).__name__}.rest_state: {self.rest_state!r}; {n_extra} "
                "finite numbers are needed, one for each row after theta of a state of "
                f"{self.size}"
            )

    @property
    def name(self) -> str:
        """Class and function, as errors call them."""
        return f"{type(self).__name__}({describe_function(self.function)})"

    @property
    def state_size(self) -> int:
        """Number of rows m."""
        return self.size

    def extend(self, poses: np.ndarray) -> np.ndarray:
        """Append `rest_state` to poses (n, 3): (n, m)."""
        return append_rows(poses, self.rest_state or (0.0,) * (self.size - 3))

    def saturate(self, control: Any) -> Any:
        """Limit the control (n,), or each of (k, n), with `soft_limit`."""
        limits = self.limit if isinstance(self.limit, tuple) else (self.limit,)
        if self.controls == 1:
            return soft_limit(control, limits[0])
        limits *= self.controls // len(limits)
        pairs = zip(control, limits, strict=True)
        return type(control)(*[soft_limit(row, limit) for row, limit in pairs])


@dataclass(frozen=True)
class FunctionDynamics(AbstractUserDynamics):
    """Vehicle model `dx/dt = function(state, control)`.

    Example, a car that speeds up with the fourth row as its speed:

    >>> import drjit as dr
    >>> def car(state, control):
    ...     _, _, theta, speed = state
    ...     return speed * dr.cos(theta), speed * dr.sin(theta), control, 8 - speed
    >>> FunctionDynamics(car, size=4, limit=1.5, rest_state=(5.0,)).state_size
    4

    Args:
        function: maps a state (m, n) and a control (n,), or several (k, n), within
            its limit, to the m rows of the derivative, in Dr.Jit operations. It returns
            an array of the state's type, or a list or tuple of rows. It treats each
            vehicle alone. It reads nothing that changes, because it is called once and
            its kernels are recorded.
        size: m, at least 3; the first rows are px, py, theta.
        limit: of ``|control|``, in its unit; applied by `soft_limit`. Of several
            controls one for all, or one for each.
        rest_state: initial values of the m - 3 rows after theta; zeros if left out.
        controls: k, their number.
    """

    def derivative(self, state: Any, control: Any) -> Any:
        """Call the function.

        Raises:
            InputError: it failed, or returned something else than m rows, one entry a
                vehicle, or rows that do not depend on the control by Dr.Jit operations.
        """
        result = call_model(self.name, self.function, state, control=control)
        result = self._rows(result, state)
        if dr.grad_enabled(control) and not dr.grad_enabled(result):
            raise InputError(
                f"{self.name}: what it returned has no derivative by the control; "
                "write it in Dr.Jit operations, without NumPy and dr.detach"
            )
        return result

    def check(self, state: Any) -> None:
        """Raise `InputError` where a state (m, n) is not finite."""
        require_finite(self.name, state.numpy().T)

    def _rows(self, value: Any, state: Any) -> Any:
        """Bring what the function returned into the type of the state."""
        kind, row = type(state), type(state[0])
        array = dr.is_array_v(value) and not dr.is_tensor_v(value)
        if not (array and dr.depth_v(value) == 2 or isinstance(value, list | tuple)):
            shape = getattr(value, "shape", None)
            description = type(value).__name__ + (f" of shape {shape}" if shape else "")
            raise InputError(self._expected(description))
        if len(value) != self.size:
            raise InputError(self._expected(f"{len(value)} rows"))
        # Rows of the state's precision, with one entry per vehicle or one for all
        try:
            rows = [row(item) for item in value]
        except (TypeError, RuntimeError) as err:
            kinds = ", ".join(type(item).__name__ for item in value)
            raise InputError(self._expected(f"rows ({kinds})")) from err
        widths = [dr.width(item) for item in rows]
        if any(width not in (1, dr.width(state)) for width in widths):
            raise InputError(self._expected(f"rows of {widths} entries"))
        return kind(*rows)

    def _expected(self, description: str) -> str:
        return (
            f"{self.name}: returned {description}; {self.size} rows are needed, one "
            "number for each vehicle"
        )


def user_controls(count: int) -> tuple[str, ...]:
    """Name the controls of a user's model: "control", or "control_0", ..."""
    return ("control",) if count == 1 else tuple(f"control_{i}" for i in range(count))


def describe_function(function: Callable[..., Any]) -> str:
    """Name a function by its file and name, other callables by their class."""
    code = getattr(function, "__code__", None)
    name = getattr(function, "__qualname__", type(function).__qualname__)
    return name if code is None else f"{Path(code.co_filename).name}:{name}"


def call_model(
    owner: str, function: Callable[[Any, Any], Any], state: Any, control: Any
) -> Any:
    """Call a function of the user's; raise `InputError` with its line if it fails."""
    try:
        return function(state, control)
    except Exception as err:
        if is_interrupt(err):
            raise
        # The first frame below this one is in the user's function
        frames = traceback.extract_tb(err.__traceback__)[1:2]
        line = f" in line {frames[0].lineno}" if frames else ""
        raise InputError(
            f"{owner}: raised {type(err).__name__}{line}: {err}; it is called with a "
            "state and a control"
        ) from err


def append_rows(poses: np.ndarray, rest_state: tuple[float, ...]) -> np.ndarray:
    """Append the same values to every pose: (n, 3) to (n, 3 + len(rest_state))."""
    poses = np.atleast_2d(np.asarray(poses, np.float64))
    return np.hstack(
        [poses, np.broadcast_to(rest_state, (len(poses), len(rest_state)))]
    )


def require_finite(owner: str, values: np.ndarray) -> None:
    """Raise `InputError` where states or derivatives (n, m) are not finite."""
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        vehicle = int(np.flatnonzero(~finite)[0])
        raise InputError(
            f"{owner}: gave {values[vehicle].tolist()} for vehicle {vehicle}; finite "
            "numbers are needed: check the function, or take a smaller time step"
        )
