"""How the costs of a batch of drives become the one number that is minimised."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr


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
