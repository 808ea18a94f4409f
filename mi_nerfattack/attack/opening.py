"""How a search by gradient may begin: by tries, of which the best one goes on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mi_nerfattack.attack.black_box.random_looks import RandomLooks
from mi_nerfattack.attack.objectives import SideDeviation
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.vehicle.route.route import Route

#: Iterations of a try: what its last one would change is not judged.
FEWEST = 2


@dataclass(frozen=True)
class AbstractOpening(ABC):
    """Tries from several starts.

    All are judged by the attack's own objective.

    Attributes:
        count: of tries.
        each: iterations of a try, at least `FEWEST`.

    Raises:
        InputError: a try has too few iterations.
    """

    count: ClassVar[int]

    each: int

    def __post_init__(self) -> None:
        if self.each < FEWEST:
            raise InputError(
                f"each: {self.each}; a try of fewer than {FEWEST} iterations judges "
                "nothing but its start"
            )

    def textures(self, number: int) -> list[np.ndarray] | None:
        """Return the textures that a try starts from, None: as they were."""
        del number

    def offsets(self, number: int) -> np.ndarray | None:
        """Return the offsets (k, 6) that a try starts from, None: as they were."""
        del number

    @abstractmethod
    def rollout(self, rollout: Rollout, number: int) -> Rollout:
        """Return the rollout whose gradient a try follows."""


@dataclass(frozen=True)
class Sides(AbstractOpening):
    """Two tries from the original, one to the left and one to the right.

    A distance has two directions, and near the lane centre its gradient depends on
    which side the drive happens to be. Each try follows that of one side.

    Attributes:
        route: the lane centre.
    """

    count = 2

    route: Route

    def rollout(self, rollout: Rollout, number: int) -> Rollout:
        """See :meth:`AbstractOpening.rollout`."""
        cost = SideDeviation(self.route, -1.0 if number else 1.0)
        return replace(rollout, objective=StageSum(cost))


@dataclass(frozen=True)
class Restarts(AbstractOpening):
    """Three tries: the first from the original, the others from random textures.

    Attributes:
        looks: the draws.
    """

    count = 3

    looks: RandomLooks

    def textures(self, number: int) -> list[np.ndarray] | None:
        """See :meth:`AbstractOpening.textures`."""
        return self.looks.textures(number - 1) if number else None

    def offsets(self, number: int) -> np.ndarray | None:
        """See :meth:`AbstractOpening.offsets`."""
        return self.looks.offsets(number - 1) if number else None

    def rollout(self, rollout: Rollout, number: int) -> Rollout:
        """See :meth:`AbstractOpening.rollout`."""
        del number
        return rollout
