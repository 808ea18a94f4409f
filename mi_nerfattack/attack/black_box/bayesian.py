"""Bayesian optimisation on the lowest frequencies of textures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.black_box.search import AbstractSearch, Proposal
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra

if TYPE_CHECKING:
    from optuna.trial import Trial

#: Coefficients beyond which a Gaussian process learns too little from few drives.
MOST = 64
_RANDOM_FIRST = 10


class BayesianSearch(AbstractSearch):
    """Fits a Gaussian process to all objectives, and asks where it expects a gain.

    Args:
        basis: of the textures, at most 64 coefficients.
        seed: of all draws.

    Raises:
        InputError: the basis has more coefficients.
        SetupError: Optuna is not installed.

    Source: Hvarfner et al., ICML 2024 (dimension-scaled priors); Optuna's `GPSampler`.
    """

    def __init__(self, basis: LowFrequency, seed: int = 0) -> None:
        if basis.count > MOST:
            raise InputError(f"coefficients: {basis.count}; at most {MOST}")
        optuna = load_extra("optuna", "Bayesian optimisation")
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.basis = basis
        # Random proposals come first; then the Gaussian process chooses
        sampler = optuna.samplers.GPSampler(seed=seed, n_startup_trials=_RANDOM_FIRST)
        self._study = optuna.create_study(sampler=sampler)
        # A coefficient changes sRGB values by at most 1
        one = optuna.distributions.FloatDistribution(-1.0, 1.0)
        self._space = {f"{i:02d}": one for i in range(basis.count)}
        self._asked: Trial | None = None

    def ask(self) -> Proposal:
        """See :meth:`AbstractSearch.ask`; asked again, it asks the same."""
        asked: Trial = self._asked or self._study.ask(dict(self._space))
        self._asked = asked
        return self.basis.propose(np.array([asked.params[k] for k in self._space]))

    def tell(self, objective: float) -> None:
        """See :meth:`AbstractSearch.tell`."""
        assert self._asked is not None  # it was asked
        self._study.tell(self._asked, objective)
        self._asked = None
