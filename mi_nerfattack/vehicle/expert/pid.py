"""PID controller of the cross-track error, for cars that take a steering angle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Acute, Positive, Seconds, checked
from mi_nerfattack.vehicle.expert.base import AbstractExpert
from mi_nerfattack.vehicle.route.route import Route


@dataclass(eq=False)
@checked("PIDExpert")
class PIDExpert(AbstractExpert):
    """Steering angle `atan(l kappa) - (K_p e + K_i int e dt + K_d de/dt)`.

    e is the cross-track error, `de/dt = v sin(psi)` with the heading error psi, so
    that a single state suffices for it and no noise is amplified; kappa is the
    route's curvature. The gains follow from a look-ahead distance d as those of
    `LaneFollower`: `K_p = l / d^2`, `K_d = 2 l / (d v)`, `K_i = K_p / T_i`. The
    integral removes what a bent steering rod or slip would leave; it rests where the
    angle is at its limit and the error would push it further, and while the error is
    larger than a quarter of d, which is no lasting deviation but a recovery.

    Args:
        route: to follow, closed or not.
        period: seconds between two calls of `control`.
        wheelbase: l, metres.
        max_control: limit of the steering angle, radians, below pi/2.
        look_ahead_m: d, metres.
        preview_m: arc length ahead at which the curvature is read, metres.
        integral_time: T_i, seconds.
        window_m: arc length over which the polyline's curvature is averaged, metres.
    """

    route: Route
    period: Seconds
    wheelbase: Positive
    max_control: Acute
    look_ahead_m: Positive
    preview_m: float = 0.0
    integral_time: Seconds = 5.0
    window_m: Positive = 0.2

    control_unit: ClassVar[str] = "rad"

    def __post_init__(self) -> None:
        self.proportional = self.wheelbase / self.look_ahead_m**2
        self.derivative = (
            2 * self.proportional * self.look_ahead_m / self.route.speed_ms
        )
        self.integral = self.proportional / self.integral_time
        self._sum: np.ndarray | None = None

    def reset(self) -> None:
        """Forget the integrals."""
        self._sum = None

    def control(self, states: Any) -> np.ndarray:
        """Compute steering angles (n,), radians, and integrate one period further.

        Args:
            states: (n, m) or (m,), metres and radians, of the same vehicles as in
                the call before.

        Raises:
            InputError: their number has changed since `reset`.
        """
        states = np.atleast_2d(np.asarray(states, np.float64))
        if self._sum is None:
            self._sum = np.zeros(len(states))
        if len(self._sum) != len(states):
            raise InputError(
                f"PIDExpert: {len(states)} states after {len(self._sum)}; "
                "call reset before other vehicles"
            )
        arc, error, _ = self.route.project_numpy(states)
        rate = self.route.speed_ms * np.sin(states[:, 2] - self.route.heading_at(arc))
        curvature = self.route.curvature_at(arc + self.preview_m, self.window_m)
        angle = np.arctan(self.wheelbase * curvature)
        angle -= self.proportional * error + self.derivative * rate
        angle -= self.integral * self._sum
        limited = np.clip(angle, -self.max_control, self.max_control)
        # a positive error makes the angle smaller
        pushes = (angle - limited) * error < 0
        rests = pushes | (np.abs(error) > self.look_ahead_m / 4)
        self._sum = self._sum + np.where(rests, 0.0, error * self.period)
        return limited
