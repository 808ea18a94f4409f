"""Kinematic bicycle referred to its centre of gravity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_nerfattack.vehicle.dynamics import (
    AbstractDynamics,
    require_positive,
    require_steer,
    soft_limit,
)


@dataclass(frozen=True)
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
        max_steer: limit of |u|, radians, below pi/2.
    """

    speed: float = 5.0
    front_m: float = 1.35
    rear_m: float = 1.35
    max_steer: float = 0.6

    def __post_init__(self) -> None:
        require_positive(
            "KinematicBicycle",
            speed=self.speed,
            front_m=self.front_m,
            rear_m=self.rear_m,
        )
        require_steer("KinematicBicycle", self.max_steer)

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
