"""The number that is minimised, as a function of a batch of drives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.backend.differentiate import vjp
from mi_nerfattack.rollout.loop import Trajectory
from mi_nerfattack.rollout.objective import AbstractObjective, StateHistory
from mi_nerfattack.rollout.reduction import AbstractReduction


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
