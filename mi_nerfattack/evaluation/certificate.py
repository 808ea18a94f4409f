"""The mathematics of both certificates: bounds by smoothing, truth of gradients.

A drive departs or it does not. Let z be coefficients of a texture, and let h(z) be the
chance that a drive past the texture departs. The *smoothed* chance at z is the mean of
h over Gaussian changes of z::

    H(z) = E[h(z + e)],  e normal with standard deviation s in each coefficient

For every h between 0 and 1 the function ``probit(H(z))`` changes by at most ``1 / s``
per unit of z. So H within a radius r of z is at most ``Phi(probit(H(z)) + r / s)``. No
smaller bound holds for all h: a half-space of departures reaches it.

Source: Cohen, Rosenfeld and Kolter, ICML 2019; Salman et al., NeurIPS 2019, lemma 2;
Clopper and Pearson, Biometrika 1934.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def chance_interval(count: int, total: int, confidence: float) -> tuple[float, float]:
    """Return an exact interval of a chance (Clopper-Pearson).

    Args:
        count: how often something happened.
        total: of how many independent times, at least 1.
        confidence: least chance that the interval holds the true value.
    """
    import scipy.stats  # it takes a second

    interval = scipy.stats.binomtest(count, total).proportion_ci(confidence, "exact")
    return float(interval.low), float(interval.high)


def chance_bound(count: int, total: int, confidence: float) -> float:
    """Return the upper end of the one-sided interval; see :func:`chance_interval`."""
    import scipy.stats  # it takes a second

    test = scipy.stats.binomtest(count, total, alternative="less")
    return float(test.proportion_ci(confidence, "exact").high)


def bound_within(chance: float, radius: float, sd: float) -> float:
    """Bound the smoothed chance at all points within a radius.

    Args:
        chance: the smoothed chance at the centre, or its upper bound.
        radius: Euclidean, in units of the coefficients, at least 0.
        sd: standard deviation s of the noise in each coefficient.
    """
    import scipy.stats  # it takes a second

    return float(scipy.stats.norm.cdf(scipy.stats.norm.ppf(chance) + radius / sd))


#: A gradient is true where the lower end of the cosine's interval and the slope are so.
LEAST_COSINE, SLOPES = 0.5, (0.5, 2.0)


@dataclass(frozen=True)
class Agreement:
    """How predicted changes of an objective agree with real changes.

    Let g be the gradient of the real objective, and p the gradient that predicts. For
    normal directions of equal standard deviation, the slope goes to ``<g, p> / <p, p>``
    and the cosine to the cosine of the angle between g and p.

    Attributes:
        slope: least squares of real by predicted changes, through zero.
        slope_ci95: Student's interval.
        cosine: of the angle between real and predicted changes.
        cosine_ci95: by Fisher's transformation.
    """

    slope: float
    slope_ci95: tuple[float, float]
    cosine: float
    cosine_ci95: tuple[float, float]

    @property
    def is_true(self) -> bool:
        """Whether a step along the gradient does about what the gradient says."""
        low, high = SLOPES
        return self.cosine_ci95[0] >= LEAST_COSINE and low <= self.slope <= high


def agreement(predicted: np.ndarray, real: np.ndarray) -> Agreement | None:
    """Compare changes (n,) of an objective along n random directions, n at least 3.

    Returns:
        None where all changes of one kind are zero.

    Source: Fisher, Metron 1921; n less 2, because both means are known to be zero.
    """
    import scipy.stats  # it takes a second

    n, square = len(real), float(predicted @ predicted)
    if n < 3 or not square or not real.any():
        return None
    slope = float(predicted @ real) / square
    residuals = real - slope * predicted
    error = float(np.sqrt(residuals @ residuals / (n - 1) / square))
    reach = float(scipy.stats.t.ppf(0.975, n - 1)) * error
    cosine = float(predicted @ real) / float(np.sqrt(square * (real @ real)))
    at = np.arctanh(np.clip(cosine, -1 + 1e-12, 1 - 1e-12))
    width = float(scipy.stats.norm.ppf(0.975)) / np.sqrt(n - 2)
    ends = float(np.tanh(at - width)), float(np.tanh(at + width))
    return Agreement(slope, (slope - reach, slope + reach), cosine, cosine_ci95=ends)
