"""Vehicle models: their interface, and two whose state is position and heading.

A state is a Dr.Jit array of m rows, `(px, py, theta, ...)` in metres and radians,
theta counter-clockwise from +x; each row holds the n vehicles of a batch. Any
floating-point type of any backend works (`Array3f`, `Array3f64`, for m > 3 `ArrayXf64`;
LLVM or CUDA, with or without derivatives).

A vehicle takes one control, a row (n,), or k > 1 of them, an array of k rows (k, n) of
the type `ArrayXf64`, in the order of its `control_names`.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import rows_type, upload_rows
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Acute, Positive, checked

#: Step of the controls, SI units; share of a speed that a control may change at once.
_CONTROL_STEP, _SPEED_SHARE = 0.1, 0.01


def state_type(size: int = 3) -> Any:
    """Type of a batch of states of `size` rows, of the active variant, double."""
    if size == 3:
        return dr.float64_array_t(mi.Vector3f)
    return sys.modules[mi.Float.__module__].ArrayXf64


def to_state(states: np.ndarray) -> Any:
    """Upload states (n, m), metres and radians first, as an opaque (m, n) array.

    Raises:
        ValueError: another shape, less than three columns, or not finite.
    """
    states = np.atleast_2d(np.asarray(states, np.float64))
    if states.ndim != 2 or states.shape[1] < 3 or not np.isfinite(states).all():
        raise ValueError(f"states: shape {states.shape}; expected finite (n, 3)")
    kind = state_type(states.shape[1])
    result = upload_rows(kind, states)
    dr.make_opaque(result)
    return result


def to_control(values: np.ndarray) -> Any:
    """Upload controls (n, k) of n vehicles, opaque: (n,) if k = 1, otherwise (k, n)."""
    row = dr.value_t(state_type())
    rows = [row(column) for column in np.asarray(values, np.float64).T.tolist()]
    result = rows[0] if len(rows) == 1 else rows_type(row)(*rows)
    dr.make_opaque(result)
    return result


def controls_as(row: Any, controls: Any) -> Any:
    """Convert the controls of n vehicles to another precision.

    Args:
        row: type of one control, such as `mi.Float` or `mi.Float64`.
        controls: (n,) or (k, n); Dr.Jit, any float type.

    Returns:
        (n,) or, of k > 1 controls, (k, n).
    """
    if dr.depth_v(controls) == 1:
        return row(controls)
    rows = [row(item) for item in controls]
    return rows[0] if len(rows) == 1 else rows_type(row)(*rows)


def no_control(size: int, like: Any) -> Any:
    """Return the control 0 of vehicles that take `size`, opaque.

    Args:
        size: number of controls.
        like: any state (m, n).

    Returns:
        (n,) or (size, n), detached.
    """
    row = dr.detached_t(type(like[0]))
    rows = [dr.opaque(row, 0, dr.width(like)) for _ in range(size)]
    return rows[0] if size == 1 else rows_type(row)(*rows)


def control_size(control: Any) -> int:
    """Return the number of controls in (n,) or (k, n)."""
    return 1 if dr.depth_v(control) == 1 else len(control)


def require_controls(count: int, names: Sequence[str]) -> None:
    """Raise `InputError` unless a policy gives as many controls as its vehicle takes.

    Args:
        count: number of controls of an image.
        names: of the controls that the vehicle takes.
    """
    if count != len(names):
        raise InputError(
            f"controls: the policy gives {count}, the vehicle takes {len(names)}: "
            f"{', '.join(names)}; let the policy return so many, in this order, or "
            "take another vehicle"
        )


def soft_limit(value: Any, limit: Any) -> Any:
    """Limit a value smoothly: `x / (1 + (x/limit)^8)^(1/8)`.

    The function is odd and strictly increasing. Up to half the limit it equals its
    argument within 0.05 %; at the limit its value is 0.92 of the limit. The derivative
    `(1 + (x/limit)^8)^(-9/8)` is never zero, so that a gradient can still move a
    saturated control. A hyperbolic tangent would change the gain of a controller by
    10 % at half the limit.

    Args:
        value: Dr.Jit array, any shape, in the unit of `limit`.
        limit: positive bound that the result approaches; a number, or an array.

    Returns:
        Array of the same shape, between -limit and limit.
    """
    ratio = value / limit
    inside = dr.abs(ratio) < 1
    # Of the ratio and its inverse the one that is at most 1: nothing overflows.
    small = dr.select(inside, ratio, 1 / dr.select(inside, 1, ratio))
    # (1 + small^8)^(-1/8), by squares and square roots alone
    scale = 1 / dr.sqrt(dr.sqrt(dr.sqrt(1 + dr.square(dr.square(dr.square(small))))))
    return limit * scale * dr.select(inside, ratio, dr.sign(ratio))


@dataclass(frozen=True)
class AbstractDynamics(ABC):
    """Continuous-time vehicle model `dx/dt = f(x, u)` with one or several controls.

    Write your own by giving `derivative` and `saturate` in Dr.Jit operations; every
    derivative that the adjoint needs follows from automatic differentiation.

    Attributes:
        recordable: whether `derivative` consists of Dr.Jit operations alone, so that
            `drjit.freeze` can record it; false where it calls another library.
        control_names: of the controls, in their order: "heading_rate" (rad/s),
            "steering" (rad), "acceleration" (m/s^2), or names of your own.
    """

    recordable: ClassVar[bool] = True
    control_names: ClassVar[tuple[str, ...]] = ("control",)

    @property
    def control_size(self) -> int:
        """Number k of controls."""
        return len(self.control_names)

    @property
    def state_size(self) -> int:
        """Number m of rows of a state; the first three are px, py, theta."""
        return 3

    @property
    def own_rows(self) -> int:
        """Number of rows that costs see; the others are those of a `Variation`."""
        return self.state_size

    def extend(self, poses: np.ndarray) -> np.ndarray:
        """Complete poses to states at rest in all other rows.

        Args:
            poses: (n, 3), metres and radians.

        Returns:
            (n, m), zeros appended.
        """
        poses = np.atleast_2d(np.asarray(poses, np.float64))
        return np.pad(poses, ((0, 0), (0, self.state_size - poses.shape[1])))

    @abstractmethod
    def derivative(self, state: Any, control: Any) -> Any:
        """Compute the time derivative of the state.

        Args:
            state: (m, n), metres and radians.
            control: (n,), or (k, n) of k > 1, within its limits: call `saturate`
                before.

        Returns:
            (m, n), metres per second and radians per second.
        """

    def jacobian(self, state: Any, control: Any) -> list[Any]:
        """Compute df/dx by forward-mode differentiation.

        Args:
            state: (m, n), treated as a constant.
            control: (n,) or (k, n), treated as a constant.

        Returns:
            m columns, each (m, n): column j is df/dx_j, detached.
        """
        columns = []
        # A model need not depend on every row: Dubins ignores the position. Nor may
        # the input's gradient be cleared, for a result can be an input, as in
        # `dx/dt = v`.
        flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
        for row in range(len(state)):
            with dr.resume_grad():
                rows = [type(item)(dr.detach(item)) for item in state]
                dr.enable_grad(rows[row])
                slope = self.derivative(type(state)(*rows), dr.detach(control))
                dr.set_grad(rows[row], 1)
                columns.append(dr.detach(dr.forward_to(slope, flags=flags)))
        return columns

    @abstractmethod
    def saturate(self, control: Any) -> Any:
        """Limit a commanded control smoothly to what the vehicle can do.

        Args:
            control: (n,), or (k, n) of k > 1.

        Returns:
            of the same shape.
        """

    def speed_of(self, state: Any) -> Any:
        """Return speeds (n,) along the headings of states (m, n), m/s; signed.

        Differentiable; with the control 0, which moves no vehicle at once.

        Raises:
            InputError: the speed follows a control at once, so a state has none.
        """
        if not self.has_speed:
            name = getattr(self, "name", type(self).__name__)
            raise InputError(
                f"{name}: a control sets its speed at once, so its state has no "
                "speed to give to the policy; let the speed be a row of the state, or "
                'leave "speed" out of policy.inputs'
            )
        none = dr.zeros(type(state[0]), dr.width(state))
        return self._speed_with(state, [none] * self.control_size)

    def _speed_with(self, state: Any, rows: Sequence[Any]) -> Any:
        """Compute speeds (n,) of states (m, n) under controls of k rows (n,)."""
        control = rows[0] if len(rows) == 1 else rows_type(type(rows[0]))(*rows)
        slope = self.derivative(state, control)
        sin, cos = dr.sincos(state[2])
        return slope[0] * cos + slope[1] * sin

    @cached_property
    def has_speed(self) -> bool:
        """Whether states say the speed: no control changes the initial one at once.

        Controls of opposite signs are compared, because slip by steering changes the
        speed along the heading, too, equally to both sides.
        """
        if type(self).speed_of is not AbstractDynamics.speed_of:
            return True
        state = to_state(self.extend(np.zeros((1, 3))))
        row = dr.value_t(type(state))
        steps = _CONTROL_STEP * np.eye(self.control_size)
        ends = [
            self._speed_with(state, [row(value) for value in sign * step]).numpy()
            for step in steps
            for sign in (1, -1)
        ]
        up, down = np.array(ends).reshape(-1, 2).T
        largest = np.maximum(abs(up), abs(down))
        return bool((abs(up - down) <= _SPEED_SHARE * largest).all())

    def numbered(self, first: int) -> AbstractDynamics:
        """Return this model with another number of the first drive of each batch.

        By default all drives have the same vehicle.
        """
        del first
        return self

    def constants(self, state: Any) -> list[Any]:
        """Return the arrays that :meth:`derivative` reads besides a state (m, n)."""
        del state
        return []

    def delays(self, count: int) -> np.ndarray | None:
        """Return delays (n,) of the controls of `count` vehicles, seconds, or None.

        They add to that of the closed loop. By default there are none.
        """
        del count
        return None

    def check(self, state: Any) -> None:
        """Raise `InputError` where a state (m, n) shows that the model has failed.

        Models of ours cannot; for others this waits for the device.
        """
        del state


@dataclass(frozen=True)
@checked("Dubins")
class Dubins(AbstractDynamics):
    """Vehicle of fixed speed steered by its heading rate.

    `dx/dt = (v cos theta, v sin theta, u)`. Source: appendix A.7.

    Args:
        speed: v, metres per second.
        max_heading_rate: limit of ``|u|``, radians per second.
    """

    speed: Positive = 5.0
    max_heading_rate: Positive = 1.5

    control_names: ClassVar[tuple[str, ...]] = ("heading_rate",)

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (3, n) from state (3, n) and heading rate (n,) in rad/s."""
        sin, cos = dr.sincos(state[2])
        return type(state)(self.speed * cos, self.speed * sin, control)  # A.7

    def saturate(self, control: Any) -> Any:
        """Limit the heading rate (n,) with `soft_limit`."""
        return soft_limit(control, self.max_heading_rate)


@dataclass(frozen=True)
@checked("Ackermann")
class Ackermann(AbstractDynamics):
    """Bicycle model of fixed speed steered by the angle of its front wheels.

    `dx/dt = (v cos theta, v sin theta, v/l tan u)`, referred to the rear axle.
    Source: appendix A.8, with the tangent of the steering angle where the printed
    equation has that of the heading.

    Args:
        speed: v, metres per second.
        wheelbase: l, metres.
        max_steer: limit of ``|u|``, radians, below pi/2.
    """

    speed: Positive = 5.0
    wheelbase: Positive = 2.7
    max_steer: Acute = 0.6

    control_names: ClassVar[tuple[str, ...]] = ("steering",)

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (3, n) from state (3, n) and steering angle (n,) in radians."""
        sin, cos = dr.sincos(state[2])
        heading_rate = self.speed / self.wheelbase * dr.tan(control)  # A.8, corrected
        return type(state)(self.speed * cos, self.speed * sin, heading_rate)

    def saturate(self, control: Any) -> Any:
        """Limit the steering angle (n,) with `soft_limit`."""
        return soft_limit(control, self.max_steer)
