"""What a drive costs, and how the costs of a batch become one number.

The largest cost of a batch is that of the initial pose on which an attack does least,
so that `CVaR` and `Worst` ask for an attack that works from all of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import numpy as np

from mi_nerfattack.backend.arrays import vjp
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import SomeShare, checked
from mi_nerfattack.vehicle.dynamics import to_state

if TYPE_CHECKING:
    from mi_nerfattack.rollout.loop import Trajectory

#: Maps states (m, k) to their costs (k,), in Dr.Jit operations.
StageCost = Callable[[Any], Any]


@dataclass(frozen=True)
class StateHistory:
    """All states of a batch of drives but the initial ones, as one wide array.

    Attributes:
        rows: (m, n T): entry ``i T + t - 1`` is the state of vehicle i after t control
            periods, t = 1 to T; its first three rows are px, py (metres), theta
            (radians).
        count: n.
        horizon: T.
        dt: control period, seconds.
    """

    rows: Any
    count: int
    horizon: int
    dt: float

    @classmethod
    def of(cls, states: np.ndarray, dt: float) -> StateHistory:
        """Lay the drives side by side.

        Args:
            states: (n, T, m), of each drive the state after each control period.
            dt: control period, seconds.
        """
        count, horizon, size = states.shape
        return cls(to_state(states.reshape(-1, size)), count, horizon, dt)

    @property
    def time(self) -> Any:
        """Seconds since the start, (n T,)."""
        index = dr.arange(dr.uint32_array_t(self._row), self.count * self.horizon)
        return self.dt * (self._row(index % self.horizon) + 1)

    @property
    def final(self) -> Any:
        """State of each vehicle after the last control period, (m, n)."""
        # Entry i T + T - 1 is the last state of vehicle i
        vehicle = dr.arange(dr.uint32_array_t(self._row), self.count)
        index = vehicle * self.horizon + (self.horizon - 1)
        rows = [self.rows[i] for i in range(len(self.rows))]
        return type(self.rows)([dr.gather(type(row), row, index) for row in rows])

    def total(self, values: Any) -> Any:
        """Sum values (n T,) over the time of each drive: (n,)."""
        return dr.block_reduce(dr.ReduceOp.Add, values, self.horizon)

    def running(self, values: Any) -> Any:
        """Sum values (n T,) from the start of each drive up to each time: (n T,)."""
        return dr.block_prefix_reduce(
            dr.ReduceOp.Add, values, self.horizon, exclusive=False
        )

    def spread(self, weights: Any) -> Any:
        """Repeat one number per control period, (T,), for all drives: (n T,).

        Raises:
            InputError: not T numbers.
        """
        weights = np.asarray(weights, np.float64)
        if weights.shape != (self.horizon,):
            raise InputError(
                f"weights: shape {weights.shape}; expected ({self.horizon},), one "
                "number a control period"
            )
        values = np.tile(weights, self.count)
        # a list: memory from NumPy has an alignment of its own, and so its own kernels
        result = self._row(values.tolist())
        dr.make_opaque(result)
        return result

    @property
    def _row(self) -> Any:
        return dr.detached_t(type(self.rows[0]))


class AbstractObjective(ABC):
    """Cost of a drive. Gradient methods make it smaller.

    Members are written in Dr.Jit operations; derivatives follow from automatic
    differentiation. Each drive costs one launch forward and one backward.
    """

    @abstractmethod
    def evaluate(self, states: StateHistory) -> Any:
        """Evaluate one cost per drive, (n,), differentiable in `states.rows`."""

    def costs(self, states: np.ndarray, dt: float) -> np.ndarray:
        """Evaluate the costs of recorded drives, (n,) float64.

        Args:
            states: (n, T, m), of each drive the state after each control period.
            dt: control period, seconds.
        """
        return np.array(self.evaluate(StateHistory.of(states, dt)), np.float64)


@dataclass(frozen=True, eq=False)
class StageSum(AbstractObjective):
    """``sum_t w_t C(x_t)`` over t = 1 to T.

    Attributes:
        cost: C, maps states (m, k) to (k,), in Dr.Jit operations.
        weights: (T,) w; ones when left out.
    """

    cost: StageCost
    weights: np.ndarray | None = None

    def evaluate(self, states: StateHistory) -> Any:
        """See :meth:`AbstractObjective.evaluate`."""
        values = self.cost(states.rows)
        if self.weights is not None:
            values = values * states.spread(self.weights)
        return states.total(values)


@dataclass(frozen=True, eq=False)
class Terminal(AbstractObjective):
    """``C(x_T)``: what counts is where the drive ends.

    Attributes:
        cost: C, maps states (m, n) to (n,), in Dr.Jit operations.
    """

    cost: StageCost

    def evaluate(self, states: StateHistory) -> Any:
        """See :meth:`AbstractObjective.evaluate`."""
        return self.cost(states.final)


@dataclass(frozen=True, eq=False)
class WeightedSum(AbstractObjective):
    """``sum_k a_k J_k`` of other objectives; mind that their units differ.

    Attributes:
        terms: pairs of a weight a_k and an objective J_k, at least one.
    """

    terms: tuple[tuple[float, AbstractObjective], ...]

    def __post_init__(self) -> None:
        if not self.terms:
            raise InputError("WeightedSum.terms: empty; give at least one objective")

    def evaluate(self, states: StateHistory) -> Any:
        """See :meth:`AbstractObjective.evaluate`."""
        costs = [weight * term.evaluate(states) for weight, term in self.terms]
        return sum(costs[1:], costs[0])


class AbstractReduction(ABC):
    """One number from the costs of n drives."""

    @abstractmethod
    def reduce(self, costs: Any) -> Any:
        """Reduce (n,) to one entry, differentiable."""


@dataclass(frozen=True)
@checked()
class Mean(AbstractReduction):
    """The mean over the batch."""

    kind: Literal["mean"] = "mean"

    def reduce(self, costs: Any) -> Any:
        """See :meth:`AbstractReduction.reduce`."""
        return dr.mean(costs)


@dataclass(frozen=True)
@checked("CVaR")
class CVaR(AbstractReduction):
    """Conditional value at risk: the mean of the worst fraction f of the drives.

    With costs sorted downwards, the first ``floor(f n)`` count fully and the next one,
    at the quantile, with the rest of ``f n``; the sum is divided by ``f n``. A fraction
    of 1 gives the mean; one of 1/n or less gives the largest cost. Drives of equal
    cost share their weight equally, which is one of the subgradients.

    Source: Rockafellar and Uryasev 2002, proposition 8.

    Attributes:
        fraction: f, in (0, 1].
    """

    fraction: SomeShare
    kind: Literal["cvar"] = "cvar"

    def reduce(self, costs: Any) -> Any:
        """See :meth:`AbstractReduction.reduce`."""
        return _tail_mean(costs, self.fraction * dr.width(costs))


@dataclass(frozen=True)
@checked()
class Worst(AbstractReduction):
    """The largest cost; equally large ones share the derivative equally."""

    kind: Literal["worst"] = "worst"

    def reduce(self, costs: Any) -> Any:
        """See :meth:`AbstractReduction.reduce`."""
        return _tail_mean(costs, 1.0)


def _tail_mean(costs: Any, mass: float) -> Any:
    """Average the `mass` largest of n costs; compares all pairs, n^2 entries."""
    count, values = dr.width(costs), dr.detach(costs)
    # For each drive: how many drives cost more, and how many cost the same
    pair = dr.arange(dr.uint32_array_t(type(values)), count * count)
    own = dr.gather(type(values), values, pair // count)
    other = dr.gather(type(values), values, pair % count)
    greater = _count(other > own, own, count)
    equal = _count(other == own, own, count)  # itself included
    # Drives of equal cost share what the costlier drives leave of the mass
    weight = dr.clip(mass - greater, 0, equal) / (equal * mass)
    return dr.sum(weight * costs)


def _count(mask: Any, like: Any, block: int) -> Any:
    return dr.block_reduce(
        dr.ReduceOp.Add, dr.select(mask, type(like)(1), type(like)(0)), block
    )


@dataclass(frozen=True)
class Cost:
    """An objective of each drive, reduced over the batch.

    Attributes:
        objective: cost of one drive.
        reduction: of the batch.
        scale: factor of all derivatives.
    """

    objective: AbstractObjective
    reduction: AbstractReduction
    scale: float = 1.0

    def of(self, drive: Trajectory) -> tuple[float, np.ndarray]:
        """Evaluate: the cost of the batch, and those of its drives, (n,)."""
        costs = self.objective.evaluate(drive.history())
        return float(self.reduction.reduce(costs)[0]), np.array(costs)

    def by_states(self, drive: Trajectory) -> np.ndarray:
        """Differentiate by x_1 to x_T: (T, n, m)."""
        history = drive.history()

        def cost(rows: Any) -> Any:
            states = StateHistory(rows, history.count, history.horizon, dt=history.dt)
            return self.reduction.reduce(self.objective.evaluate(states))

        by_rows = np.array(vjp(cost, history.rows, self.scale), np.float64)
        # From (m, n T) to (T, n, m), with zeros for rows that no cost sees
        shape = (len(by_rows), history.count, history.horizon)
        unseen = len(drive.states[0]) - len(by_rows)
        by_states = by_rows.reshape(shape).transpose(2, 1, 0)
        return np.pad(by_states, ((0, 0), (0, 0), (0, unseen)))


def truncated(objective: AbstractObjective, horizon: int) -> AbstractObjective:
    """Return an objective for the first control periods of its drive.

    Weights of later periods are left out; an objective of the end takes the new end.
    """
    if isinstance(objective, StageSum) and objective.weights is not None:
        return replace(objective, weights=objective.weights[:horizon])
    if isinstance(objective, WeightedSum):
        terms = [(a, truncated(term, horizon)) for a, term in objective.terms]
        return WeightedSum(tuple(terms))
    return objective
