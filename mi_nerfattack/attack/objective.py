"""What an attack maximises, as a stage cost of the vehicle's state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mi_nerfattack.vehicle.route import Route, smooth_absolute


@dataclass(frozen=True)
class CrossTrackDeviation:
    """Minus the distance from the lane centre, rounded at zero.

    Minimising ``sum_t -(sqrt(e_t^2 + w^2) - w)`` drives the vehicle off its lane.

    Attributes:
        route: the lane centre.
        rounding_m: w.
    """

    route: Route
    rounding_m: float = 0.05

    def __call__(self, state: Any) -> Any:
        """Evaluate at states (3, n): (n,), metres, at most 0."""
        return -smooth_absolute(self.route.cross_track(state), self.rounding_m)
