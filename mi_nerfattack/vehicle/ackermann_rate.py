"""Ackermann vehicle whose wheels take time to turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_nerfattack.ranges import Acute, Positive, checked
from mi_nerfattack.vehicle.dynamics import (
    AbstractDynamics,
    soft_limit,
)


@dataclass(frozen=True)
@checked("RateLimitedAckermann")
class RateLimitedAckermann(AbstractDynamics):
    """`Ackermann` whose steering angle delta is a state that follows its command u.

    `dx/dt = (v cos theta, v sin theta, v/l tan delta, rate)` with
    `rate = soft_limit((u - delta) / tau, max_steer_rate)`: a first-order lag whose
    rate is bounded. The command is bounded by `max_steer`, and so is an angle that
    starts within it. Both limits are smooth and keep a derivative beyond them, if a
    small one: while the wheels turn at their full rate, the command hardly matters.

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

    @property
    def state_size(self) -> int:
        """4: px, py, theta, delta."""
        return 4

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (4, n) from state (4, n) and commanded angle (n,) in radians."""
        sin, cos = dr.sincos(state[2])
        heading_rate = self.speed / self.wheelbase * dr.tan(state[3])
        wanted = (control - state[3]) / self.time_constant
        steer_rate = soft_limit(wanted, self.max_steer_rate)
        return type(state)(self.speed * cos, self.speed * sin, heading_rate, steer_rate)

    def saturate(self, control: Any) -> Any:
        """Limit the commanded angle (n,) with `soft_limit`."""
        return soft_limit(control, self.max_steer)
