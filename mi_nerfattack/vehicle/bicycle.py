"""The kinematic bicycle, by its steering angle or with a lag of the steering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr

from mi_nerfattack.ranges import Acute, Positive, checked
from mi_nerfattack.vehicle.dynamics import (
    AbstractDynamics,
    soft_limit,
)


@dataclass(frozen=True)
@checked("KinematicBicycle")
class KinematicBicycle(AbstractDynamics):
    """Bicycle model of fixed speed whose position is that of its centre of gravity.

    With the slip angle `beta = atan(r / (f + r) tan u)`,
    `dx/dt = (v cos(theta + beta), v sin(theta + beta), v sin(beta) / r)`. `Ackermann`
    is the same vehicle seen from its rear axle, where there is no slip; take this one
    where a camera or a route is referred to the middle of the vehicle. It turns on a
    radius of `hypot(r, (f + r) / tan u)`. Source: Polack et al. 2017, section II.

    Args:
        speed: v, metres per second, of the centre of gravity.
        front_m: f, distance from the centre of gravity to the front axle, metres.
        rear_m: r, the same to the rear axle.
        max_steer: limit of ``|u|``, radians, below pi/2.
    """

    speed: Positive = 5.0
    front_m: Positive = 1.35
    rear_m: Positive = 1.35
    max_steer: Acute = 0.6

    control_names: ClassVar[tuple[str, ...]] = ("steering",)

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (3, n) from state (3, n) and steering angle (n,) in radians."""
        tangent = self.rear_m / (self.front_m + self.rear_m) * dr.tan(control)
        along = self.speed / dr.sqrt(1 + dr.square(tangent))  # v cos(beta)
        across = along * tangent  # v sin(beta)
        sin, cos = dr.sincos(state[2])
        return type(state)(
            cos * along - sin * across,
            sin * along + cos * across,
            across / self.rear_m,
        )

    def saturate(self, control: Any) -> Any:
        """Limit the steering angle (n,) with `soft_limit`."""
        return soft_limit(control, self.max_steer)


@dataclass(frozen=True)
@checked("RateLimitedAckermann")
class RateLimitedAckermann(AbstractDynamics):
    """`Ackermann` whose steering angle delta is a state that follows its command u.

    `dx/dt = (v cos theta, v sin theta, v/l tan delta, rate)` with
    `rate = soft_limit((u - delta) / tau, max_steer_rate)`: a first-order lag whose
    rate is bounded. The command is bounded by `max_steer`, and so is an angle that
    starts within it. Both limits are smooth, and beyond them a small derivative
    remains: while the wheels turn at their full rate, the command hardly matters.

    The lag makes the model stiff: explicit Euler needs steps below 2 tau, RK4 below
    2.7 tau.

    Args:
        speed: v, metres per second, of the rear axle.
        wheelbase: l, metres.
        max_steer: limit of ``|u|``, radians, below pi/2.
        max_steer_rate: limit of ``|d delta/dt|``, radians per second.
        time_constant: tau, seconds.
    """

    speed: Positive = 5.0
    wheelbase: Positive = 2.7
    max_steer: Acute = 0.6
    max_steer_rate: Positive = 0.7
    time_constant: Positive = 0.1

    control_names: ClassVar[tuple[str, ...]] = ("steering",)

    @property
    def state_size(self) -> int:
        """4: px, py, theta, delta."""
        return 4

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (4, n) from state (4, n) and commanded angle (n,) in radians."""
        sin, cos = dr.sincos(state[2])
        heading_rate = self.speed / self.wheelbase * dr.tan(state[3])
        unlimited_rate = (control - state[3]) / self.time_constant
        steer_rate = soft_limit(unlimited_rate, self.max_steer_rate)
        v_x, v_y = self.speed * cos, self.speed * sin
        return type(state)(v_x, v_y, heading_rate, steer_rate)

    def saturate(self, control: Any) -> Any:
        """Limit the commanded angle (n,) with `soft_limit`."""
        return soft_limit(control, self.max_steer)
