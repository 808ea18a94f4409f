"""What a drive costs: the interface between the closed loop and its objectives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.errors import InputError

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

    @property
    def time(self) -> Any:
        """Seconds since the start, (n T,)."""
        index = dr.arange(dr.uint32_array_t(self._row), self.count * self.horizon)
        return self.dt * (self._row(index % self.horizon) + 1)

    @property
    def final(self) -> Any:
        """State of each vehicle after the last control period, (m, n)."""
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
        """Repeat one number a control period, (T,), for all drives: (n T,).

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
    differentiation. Cost: one launch forward and one backward a drive.
    """

    @abstractmethod
    def evaluate(self, states: StateHistory) -> Any:
        """Evaluate one cost a drive, (n,), differentiable in `states.rows`."""


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
