"""Lane-following expert with access to the true state (appendix B.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.vehicle.dynamics import require_positive
from mi_nerfattack.vehicle.route import Route

#: Arc length over which the curvature of a polyline is averaged, metres.
CURVATURE_WINDOW = 1.0


@dataclass(frozen=True, eq=False)
class LaneFollower:
    """Feed-forward of the route's curvature with feedback of both errors.

    Heading rate `v (kappa - 2 e / d^2 - 2 sin(psi) / d)` for cross-track error e,
    heading error psi and look-ahead distance d: linearised, pure pursuit of a point
    at distance d, so deviations decay over d with a damping ratio of 0.7; but the
    feed-forward does not cut corners, which allows a gain low enough to be imitated.

    Args:
        route: lane centre to follow.
        speed: v, metres per second; the route's nominal speed unless given.
        look_ahead_m: d, metres. Longer is smoother and slower to recover.
        preview_m: arc length ahead of the vehicle at which the curvature is read,
            metres; half of what it travels during one step.
        heading_preview_m: the same for the heading: 0 for an accurate integrator,
            half a step for explicit Euler, which moves along the chord.
        max_heading_rate: limit of the result, radians per second.
    """

    route: Route
    speed: float | None = None
    look_ahead_m: float = 2.5
    preview_m: float = 0.25
    heading_preview_m: float = 0.0
    max_heading_rate: float = 1.5

    def __post_init__(self) -> None:
        if self.speed is None:
            object.__setattr__(self, "speed", float(self.route.speed_ms))
        require_positive(
            "LaneFollower",
            speed=float(self.speed or 0),
            look_ahead_m=self.look_ahead_m,
            max_heading_rate=self.max_heading_rate,
        )

    def control(self, states: Any) -> np.ndarray:
        """Compute the heading rate of a Dubins vehicle.

        Args:
            states: (n, 3) or (3,), metres and radians.

        Returns:
            (n,), radians per second, positive to the left, clipped to the limit.
        """
        states = np.atleast_2d(np.asarray(states, np.float64))
        arc, cross_track, _ = self.route.project_numpy(states)
        heading = self.route.heading_at(arc + self.heading_preview_m)
        start = arc + self.preview_m - CURVATURE_WINDOW / 2
        turn = self.route.heading_at(start + CURVATURE_WINDOW)
        curvature = (turn - self.route.heading_at(start)) / CURVATURE_WINDOW
        feedback = 2 / self.look_ahead_m * np.sin(states[:, 2] - heading)
        feedback += 2 / self.look_ahead_m**2 * cross_track
        rate = float(self.speed or 0) * (curvature - feedback)
        return np.clip(rate, -self.max_heading_rate, self.max_heading_rate)
