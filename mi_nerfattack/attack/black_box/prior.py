"""Bayesian optimisation around a prior: few dear drives, guided by many cheap ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import norm

from mi_nerfattack.attack.black_box.bayesian import MOST
from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.black_box.search import AbstractSearch, Proposal
from mi_nerfattack.errors import InputError

#: What another judge, such as a surrogate, says of a proposal, penalty and all.
PriorJudge = Callable[[Proposal], float]

_NOISE = 1e-3  # variance, as a share of the process's
_LENGTHS = (0.25, 0.5, 1.0, 2.0)  # of the process, in diagonals of what is searched
_SPREADS = (0.1, 0.3, 1.0)  # of candidates, in reaches
_CHANGED = 20  # coefficients of a candidate, on average at most


class PriorSearch(AbstractSearch):
    """Asks where a Gaussian process around a prior expects a gain.

    The process has the mean ``a + l p(x)``, where p is what another judge says of
    coefficients x. Offset a and scale l are fitted to what was told, by generalised
    least squares; one more drive, as it were, says that l is 1. A prior that misleads
    gets a small l, none below 0. The length of the Matern kernel is the likeliest of
    four. What is asked has the largest expected improvement of all candidates: further
    ones are drawn around the best after each drive, and the prior judges them. The
    first proposal is the middle.

    Args:
        basis: of the textures, at most 64 coefficients; all zeros are the middle.
        prior: cheap, as a drive in the surrogate; None: the process knows nothing.
        reach: largest change of a coefficient, sRGB.
        candidates: drawn before each proposal but the first; each costs the prior a
            judgement.
        seed: of all draws.

    Attributes:
        scale: l of the last proposal.

    Raises:
        InputError: more coefficients, a reach not above 0, or no candidates.

    Source: Cheng et al., ICML 2024 (P-BO: the surrogate as mean, its scale adapted);
    Regis and Shoemaker, 2013 (candidates that change some coefficients).
    """

    def __init__(
        self,
        basis: LowFrequency,
        prior: PriorJudge | None,
        reach: float = 0.25,
        candidates: int = 16,
        seed: int = 0,
    ) -> None:
        if basis.count > MOST:
            raise InputError(f"coefficients: {basis.count}; at most {MOST}")
        if not reach > 0 or candidates < 1:
            raise InputError(
                f"PriorSearch: reach {reach}, {candidates} candidates; a reach above 0 "
                "and at least one candidate"
            )
        self.basis, self.reach = basis, reach
        self.scale: float = 1.0
        self._prior, self._candidates, self._seed = prior, candidates, seed
        self._points = np.zeros((0, basis.count))  # what was told, then candidates
        self._guesses = np.zeros(0)  # the prior's, of the same
        self._told: list[float] = []
        self._asked: Proposal | None = None

    def ask(self) -> Proposal:
        """See :meth:`AbstractSearch.ask`; asked again, it asks the same."""
        if self._asked is None:
            told = len(self._told)
            self._draw(told)
            self._bring_forward(self._choose(told) if told else 0)
            self._asked = self.basis.propose(self._points[told])
        return self._asked

    def tell(self, objective: float) -> None:
        """See :meth:`AbstractSearch.tell`."""
        self._told.append(objective)
        self._asked = None

    def _draw(self, told: int) -> None:
        """Add candidates, and what the prior says of them."""
        rng = np.random.default_rng([self._seed, 6, told])
        drawn = np.zeros((1, self.basis.count))
        if told:
            count, size = self._candidates, self.basis.count
            spread = self.reach * rng.choice(_SPREADS, (count, 1))
            changed = rng.random((count, size)) < min(1.0, _CHANGED / size)
            changed[np.arange(count), rng.integers(size, size=count)] = True
            best = self._points[int(np.argmin(self._told))]
            drawn = best + spread * changed * rng.standard_normal((count, size))
            drawn = drawn.clip(-self.reach, self.reach)
        guesses = [self._guess(point) for point in drawn]
        self._points = np.concatenate([self._points, drawn])
        self._guesses = np.append(self._guesses, guesses)

    def _guess(self, point: np.ndarray) -> float:
        return 0.0 if self._prior is None else self._prior(self.basis.propose(point))

    def _choose(self, told: int) -> int:
        """Return the number of the candidate with the largest expected gain."""
        data = self._points[:told], np.array(self._told), self._guesses[:told]
        diagonal = self.reach * np.sqrt(self.basis.count)
        fits = [_Process(*data, share * diagonal) for share in _LENGTHS]
        process = max(fits, key=lambda fit: fit.likelihood)
        self.scale = float(process.mean[1])
        gain = process.gain(self._points[told:], self._guesses[told:])
        return int(np.argmax(gain))

    def _bring_forward(self, candidate: int) -> None:
        """Let a candidate be the next that is told."""
        told = len(self._told)
        for values in (self._points, self._guesses):
            values[[told, told + candidate]] = values[[told + candidate, told]]


@dataclass(frozen=True, eq=False)
class _Process:
    """A Gaussian process of mean ``offset + scale * guess``, given what was told.

    Attributes:
        points: (n, d) that were judged.
        told: (n,) objectives.
        guesses: (n,) of the prior.
        length: of the kernel.
    """

    points: np.ndarray
    told: np.ndarray
    guesses: np.ndarray
    length: float

    @cached_property
    def _factor(self) -> tuple[np.ndarray, bool]:
        among = self._kernel(self.points) + _NOISE * np.eye(len(self.points))
        return cho_factor(among, lower=True)

    def _kernel(self, points: np.ndarray) -> np.ndarray:
        """Return the correlation (k, n) of points (k, d) with what was judged."""
        away = np.linalg.norm(points[:, None] - self.points, axis=2)
        r = np.sqrt(5) * away / self.length
        return (1 + r + r**2 / 3) * np.exp(-r)

    @cached_property
    def mean(self) -> np.ndarray:
        """Offset and scale, (2,)."""
        columns = np.column_stack([np.ones_like(self.told), self.guesses])
        solved = cho_solve(self._factor, columns)
        matrix, right = solved.T @ columns, solved.T @ self.told
        known = float(self.guesses.var()) or 1.0  # the drive that says scale = 1
        extra = np.array([0.0, known])
        found = np.linalg.solve(matrix + np.diag(extra), right + extra)
        return found if found[1] > 0 else np.array([right[0] / matrix[0, 0], 0.0])

    @cached_property
    def _weights(self) -> tuple[np.ndarray, float]:
        """Weights (n,) of the kernel, and the variance of the process."""
        rest = self.told - self.mean[0] - self.mean[1] * self.guesses
        weights = cho_solve(self._factor, rest)
        return weights, max(float(rest @ weights) / len(rest), 1e-12)

    @property
    def likelihood(self) -> float:
        """Logarithm of the density of what was told, but for a constant."""
        _, variance = self._weights
        diagonal = np.diag(self._factor[0])
        return -0.5 * len(self.told) * np.log(variance) - np.log(diagonal).sum()

    def gain(self, points: np.ndarray, guesses: np.ndarray) -> np.ndarray:
        """Return the expected improvement (k,) over the least that was told."""
        near, (weights, variance) = self._kernel(points), self._weights
        mean = self.mean[0] + self.mean[1] * guesses + near @ weights
        left = 1 - np.einsum("kn,nk->k", near, cho_solve(self._factor, near.T))
        deviation = np.sqrt(variance * left.clip(min=1e-9))
        better = (self.told.min() - mean) / deviation
        return deviation * (better * norm.cdf(better) + norm.pdf(better))
