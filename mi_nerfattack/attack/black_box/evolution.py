"""CMA-ES on the low frequencies of textures."""

from __future__ import annotations

import numpy as np
from cmaes import CMA, SepCMA

from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.black_box.search import AbstractSearch, Proposal
from mi_nerfattack.errors import InputError

VARIANTS = ("separable", "learning_rate")


class EvolutionSearch(AbstractSearch):
    """Samples normally around a mean, and moves both as the better samples tell.

    Args:
        basis: of the textures, from the original ones on.
        variant: ``separable`` learns a variance a coefficient, which few samples
            suffice for; ``learning_rate`` all covariances, as fast as noise allows.
        spread: standard deviation of the first samples, sRGB.
        population: samples a generation; by the number of coefficients where None.
        seed: of all draws.

    Raises:
        InputError: another variant, or a population below 2.

    Source: Ros and Hansen, PPSN 2008 (separable); Nomura et al., GECCO 2023 (learning
    rate); Nomura and Shibata, `cmaes`.
    """

    def __init__(
        self,
        basis: LowFrequency,
        variant: str = "separable",
        spread: float = 0.3,
        population: int | None = None,
        seed: int = 0,
    ) -> None:
        if variant not in VARIANTS:
            raise InputError(f"variant: {variant!r}; one of {', '.join(VARIANTS)}")
        if population is not None and population < 2:
            raise InputError(f"population: {population}; at least 2")
        self.basis = basis
        # The first mean is the texture that zero coefficients give
        start = np.zeros(basis.count)
        bounds = np.tile([-1.0, 1.0], (basis.count, 1))
        options = {"bounds": bounds, "seed": seed, "population_size": population}
        self._optimiser = (
            SepCMA(start, spread, **options)
            if variant == "separable"
            else CMA(start, spread, **options, lr_adapt=True)
        )
        self._asked = start
        self._generation: list[tuple[np.ndarray, float]] = []

    def ask(self) -> Proposal:
        """See :meth:`AbstractSearch.ask`."""
        self._asked = self._optimiser.ask()
        return self.basis.propose(self._asked)

    def tell(self, objective: float) -> None:
        """See :meth:`AbstractSearch.tell`."""
        self._generation.append((self._asked, objective))
        if len(self._generation) == self._optimiser.population_size:
            self._optimiser.tell(self._generation)
            self._generation = []
