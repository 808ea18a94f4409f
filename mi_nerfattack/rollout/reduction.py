"""How the costs of a batch of drives become the one number that is minimised.

The largest cost is that of the initial pose on which an attack does least, so that
`CVaR` and `Worst` ask for an attack that works from all of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.backend.differentiate import vjp
from mi_nerfattack.ranges import SomeShare, checked
from mi_nerfattack.rollout.loop import Trajectory
from mi_nerfattack.rollout.objective import AbstractObjective, StateHistory


class AbstractReduction(ABC):
    """One number from the costs of n drives."""

    @abstractmethod
    def reduce(self, costs: Any) -> Any:
        """Reduce (n,) to one entry, differentiable."""


@dataclass(frozen=True)
class Mean(AbstractReduction):
    """The mean over the batch."""

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

    def reduce(self, costs: Any) -> Any:
        """See :meth:`AbstractReduction.reduce`."""
        return _tail_mean(costs, self.fraction * dr.width(costs))


@dataclass(frozen=True)
class Worst(AbstractReduction):
    """The largest cost; equally large ones share the derivative equally."""

    def reduce(self, costs: Any) -> Any:
        """See :meth:`AbstractReduction.reduce`."""
        return _tail_mean(costs, 1.0)


def _tail_mean(costs: Any, mass: float) -> Any:
    """Average the `mass` largest of n costs; compares all pairs, n^2 entries."""
    count, values = dr.width(costs), dr.detach(costs)
    pair = dr.arange(dr.uint32_array_t(type(values)), count * count)
    own = dr.gather(type(values), values, pair // count)
    other = dr.gather(type(values), values, pair % count)
    greater = _count(other > own, own, count)
    equal = _count(other == own, own, count)  # itself included
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
            states = StateHistory(rows, history.count, history.horizon, history.dt)
            return self.reduction.reduce(self.objective.evaluate(states))

        by_rows = np.array(vjp(cost, history.rows, self.scale), np.float64)
        shape = (len(by_rows), history.count, history.horizon)
        return by_rows.reshape(shape).transpose(2, 1, 0)
