"""Where vehicles are put along a route, at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import truncnorm

from mi_nerfattack.ranges import NonNegative, Share, checked
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True)
@checked("Scatter")
class Scatter:
    """Deviations of vehicles from the lane centre, normal and cut.

    Args:
        lateral_sd_m, lateral_max_m: offset to the left, metres; 0 for none.
        heading_sd, heading_max: angle to the route, radians; 0 for none.
        close_share: share of the vehicles whose deviations are a fifth of the drawn.
    """

    lateral_sd_m: NonNegative = 0.5
    lateral_max_m: NonNegative = 1.5
    heading_sd: NonNegative = 0.12
    heading_max: NonNegative = 0.4
    close_share: Share = 0.4

    def states(
        self, route: Route, arc: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw states (n, 3) at arc lengths (n,), metres."""
        count = len(arc)
        factor = np.where(rng.uniform(size=count) < self.close_share, 0.2, 1.0)
        lateral = cut_normal(self.lateral_sd_m, self.lateral_max_m, count, rng)
        heading = cut_normal(self.heading_sd, self.heading_max, count, rng)
        states = route.pose_at(arc, factor * lateral)
        # the route's own heading jumps at the vertices of the polyline
        states[:, 2] = route.heading_at(arc) + factor * heading
        return states


def cut_normal(
    sd: float, largest: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw (count,) normal numbers of standard deviation `sd` within +-largest."""
    if sd == 0 or largest == 0:
        return np.zeros(count)
    cut = largest / sd
    return sd * np.asarray(truncnorm.rvs(-cut, cut, size=count, random_state=rng))
