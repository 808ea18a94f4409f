"""The best attack within a ball of coefficients, by drives under noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: A drive departs or not: more deviation, in departure limits, counts as this one.
CAP = 2.0


def severity(largest_m: float, limit_m: float) -> float:
    """Return how near to a departure a drive came: 1 at the limit, at most `CAP`.

    Args:
        largest_m: its largest distance from the lane centre, metres.
        limit_m: departure limit, metres.
    """
    return min(largest_m / limit_m, CAP)


def steepest(noise: np.ndarray, severities: np.ndarray) -> np.ndarray:
    """Return the direction (d,) in which severity grows most, of length 1.

    The slope of the linear function of the noise that fits best (least squares). As
    the number of drives grows, it goes to the gradient of the mean severity under
    noise (Stein's lemma). All zeros where no severity differs from another.

    Args:
        noise: (n, d), of n drives.
        severities: (n,), of these.
    """
    rows = np.column_stack([np.ones(len(noise)), noise])
    slope = np.linalg.lstsq(rows, severities, rcond=None)[0][1:]
    length = float(np.linalg.norm(slope))
    return slope / length if length > 1e-9 * severities.max(initial=1e-9) else 0 * slope


def into_ball(point: np.ndarray, radius: float) -> np.ndarray:
    """Return the nearest point (d,) of the ball around zero."""
    length = float(np.linalg.norm(point))
    return point if length <= radius else point * (radius / length)


@dataclass(frozen=True, eq=False)
class BallSearch:
    """CMA-ES that starts at the end of a direction; what leaves the ball is projected.

    Args:
        radius: of the ball around zero.
        direction: (d,), of length 1, or zeros.
        proposals: how many points are judged; the first is the start.
        seed: of all draws.

    Source: Hansen 2016, "The CMA evolution strategy: a tutorial"; `cmaes`.
    """

    radius: float
    direction: np.ndarray
    proposals: int
    seed: int

    def best(self, judge: Callable[[np.ndarray], float]) -> np.ndarray:
        """Return the point (d,) of the ball with the largest value among the proposals.

        Args:
            judge: returns the value of a point; called once for each proposal, in an
                order that follows from the values and the seed alone.
        """
        from cmaes import CMA  # no other command needs it

        start = self.radius * self.direction
        spread = self.radius / np.sqrt(len(start))
        optimiser = CMA(start, spread, seed=self.seed)
        best, most = start, judge(start)
        generation: list[tuple[np.ndarray, float]] = []
        for _ in range(self.proposals - 1):
            asked = optimiser.ask()
            point = into_ball(asked, self.radius)
            value = judge(point)
            if value > most:
                best, most = point, value
            generation.append((asked, -value))
            if len(generation) == optimiser.population_size:
                optimiser.tell(generation)
                generation = []
        return best
