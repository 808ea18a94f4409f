"""What an attack minimises: costs of the vehicle's state, and of its whole drive.

Deviations enter negatively, so that a smaller cost is a larger failure. Everything is
written in Dr.Jit operations; derivatives follow from automatic differentiation. A cost
of the state becomes an objective through :class:`rollout.objective.StageSum` (over the
whole drive) or :class:`rollout.objective.Terminal` (at its end).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Finite, Positive, SomeShare, checked
from mi_nerfattack.rollout.objective import AbstractObjective, StateHistory
from mi_nerfattack.vehicle.route.route import Route, smooth_absolute


class AbstractWeights(ABC):
    """Weights of the control periods of a drive."""

    @abstractmethod
    def of(self, horizon: int, dt: float) -> np.ndarray | None:
        """Return (T,) float64, None for ones; entry t - 1 is of the state after t.

        Args:
            horizon: T, in control periods.
            dt: control period, seconds.

        Raises:
            InputError: they do not fit the horizon.
        """


@dataclass(frozen=True)
@checked()
class Uniform(AbstractWeights):
    """Ones."""

    kind: Literal["uniform"] = "uniform"

    def of(self, horizon: int, dt: float) -> None:
        """Return None."""


@dataclass(frozen=True)
@checked()
class Linear(AbstractWeights):
    """Weigh late times more: ``t / T``, up to 1 at the end."""

    kind: Literal["linear"] = "linear"

    def of(self, horizon: int, dt: float) -> np.ndarray:
        """Return the weights."""
        return np.arange(1, horizon + 1) / horizon


@dataclass(frozen=True)
@checked("weights")
class LastSeconds(AbstractWeights):
    """Weigh the last `last_s` seconds, rounded to whole periods, with 1, else 0."""

    last_s: Positive
    kind: Literal["last"] = "last"

    def of(self, horizon: int, dt: float) -> np.ndarray:
        """Return the weights."""
        count = round(self.last_s / dt)
        if not 1 <= count <= horizon:
            raise InputError(
                f"weights.last_s: {self.last_s!r} s is {count} control periods of "
                f"{dt!r} s; allowed are 1 to {horizon}, what the drive has"
            )
        return (np.arange(horizon) >= horizon - count).astype(np.float64)


@dataclass(frozen=True)
@checked("weights")
class Discounted(AbstractWeights):
    """Weigh early times more: ``d^((t - 1) dt)``, 1 at the first."""

    discount_per_s: SomeShare  # d, the factor from one second to the next
    kind: Literal["discount"] = "discount"

    def of(self, horizon: int, dt: float) -> np.ndarray:
        """Return the weights."""
        return self.discount_per_s ** (dt * np.arange(horizon))


@dataclass(frozen=True)
@checked("weights")
class Listed(AbstractWeights):
    """Numbers of the user's, one a control period, not all zero."""

    listed_weights: tuple[Finite, ...]
    kind: Literal["listed"] = "listed"

    def of(self, horizon: int, dt: float) -> np.ndarray:
        """Return the weights."""
        if len(self.listed_weights) != horizon:
            raise InputError(
                f"weights.listed_weights: {len(self.listed_weights)} numbers for a "
                f"horizon of {horizon}; give one a control period"
            )
        if not any(self.listed_weights):
            raise InputError("weights.listed_weights: zeros; must be not all zero")
        return np.array(self.listed_weights, np.float64)


@dataclass(frozen=True)
@checked()
class End(AbstractWeights):
    """The last state alone."""

    kind: Literal["end"] = "end"

    def of(self, horizon: int, dt: float) -> np.ndarray:
        """Return the weights."""
        return np.eye(1, horizon, horizon - 1)[0]


@dataclass(frozen=True)
@checked("CrossTrackDeviation")
class CrossTrackDeviation:
    """Minus the distance from the lane centre, rounded at zero.

    Minimising ``sum_t -(sqrt(e_t^2 + w^2) - w)`` drives the vehicle off its lane.

    Attributes:
        route: the lane centre.
        rounding_m: w, radius of the rounded corner; the derivative is zero at e = 0.
    """

    route: Route
    rounding_m: Positive = 0.05

    def __call__(self, state: Any) -> Any:
        """Evaluate at states (m, k): (k,), metres, at most 0."""
        return -smooth_absolute(self.route.cross_track(state), self.rounding_m)


@dataclass(frozen=True)
class SideDeviation:
    """Minus the deviation to one side of the lane centre, ``-s e``.

    Attributes:
        route: the lane centre.
        side: s, 1 for the left and -1 for the right.
    """

    route: Route
    side: float

    def __call__(self, state: Any) -> Any:
        """Evaluate at states (m, k): (k,), metres, negative on that side."""
        return -self.side * self.route.cross_track(state)


@dataclass(frozen=True)
class AbsoluteDeviation:
    """Minus the distance from the lane centre, ``-|e|``.

    The derivative has length 1 everywhere but at e = 0, where it is zero.

    Attributes:
        route: the lane centre.
    """

    route: Route

    def __call__(self, state: Any) -> Any:
        """Evaluate at states (m, k): (k,), metres, at most 0."""
        return -dr.abs(self.route.cross_track(state))


@dataclass(frozen=True)
@checked("HeadingDeviation")
class HeadingDeviation:
    """Minus the angle to the lane's direction, rounded at zero.

    ``-(sqrt(psi^2 + w^2) - w)``, where psi in (-pi, pi] is the angle of the heading
    from the nearest segment of the lane. Differentiable in the heading alone, because
    the direction of a polyline is constant along a segment. Where psi passes pi the
    derivative changes its sign.

    Attributes:
        route: the lane centre.
        rounding: w, radians.
    """

    route: Route
    rounding: Positive = 0.02

    def __call__(self, state: Any) -> Any:
        """Evaluate at states (m, k): (k,), radians, at most 0."""
        return -smooth_absolute(self.route.heading_error(state), self.rounding)


@dataclass(frozen=True)
@checked("TargetDistance")
class TargetDistance:
    """Distance to a path of the attacker's, rounded at zero.

    Minimising ``sum_t sqrt(d_t^2 + w^2) - w`` steers the policy onto the path, whose
    first and last segments are prolonged. The speed along it is left free.

    Attributes:
        path: where the vehicle shall drive.
        rounding_m: w.
    """

    path: Route
    rounding_m: Positive = 0.05

    def __call__(self, state: Any) -> Any:
        """Evaluate at states (m, k): (k,), metres, at least 0."""
        return smooth_absolute(self.path.cross_track(state), self.rounding_m)


@dataclass(frozen=True, eq=False)
@checked("DepartureTime")
class DepartureTime(AbstractObjective):
    """Expected time until the vehicle leaves its lane, seconds.

    ``p_t = sigmoid((limit - |e_t|) / softness)`` is the chance to be in the lane after
    t control periods. ``S_t = p_1 ... p_t`` is the chance to have been in the lane in
    all of them. The cost is ``dt (S_1 + ... + S_T)``. As the softness goes to zero, the
    cost goes to ``dt (k - 1)``, where the k-th period is the first that ends with
    ``|e| > limit``: the time of the last state before the departure. Without a
    departure the cost goes to ``dt T``.

    Far inside the lane the derivative fades as ``exp(-(limit - |e|) / softness)``.
    States after a departure add nothing to the derivative. So take a softness of about
    a third of the limit, or add some deviation by a weighted sum. At e = 0 the
    derivative is zero.

    Attributes:
        route: the lane centre.
        limit_m: the distance from it at which a vehicle has left.
        softness_m: width of the transition.
    """

    route: Route
    limit_m: Positive
    softness_m: Positive = 0.25

    def evaluate(self, states: StateHistory) -> Any:
        """See :meth:`.AbstractObjective.evaluate`."""
        # ln p_t of each period
        distance = dr.abs(self.route.cross_track(states.rows))
        stayed = _log_sigmoid((self.limit_m - distance) / self.softness_m)
        # ln S_t is a running sum
        return states.dt * states.total(dr.exp(states.running(stayed)))


def _log_sigmoid(x: Any) -> Any:
    """Compute ``-log(1 + exp(-x))`` without overflow, with its derivative at 0, too."""
    positive = x > 0
    # |x|, by the same mask as below, so that the derivative at 0 is 1/2
    size = dr.select(positive, x, -x)
    return dr.select(positive, 0, x) - dr.log(1 + dr.exp(-size))
