"""The mathematics of both certificates: exact intervals, and bounds by smoothing.

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


def chance_interval(count: int, total: int, confidence: float) -> tuple[float, float]:
    """Return an exact interval of a chance (Clopper-Pearson).

    Args:
        count: how often something happened.
        total: of how many independent times, at least 1.
        confidence: least chance that the interval holds the true value.
    """
    import scipy.stats  # it takes a second

    found = scipy.stats.binomtest(count, total).proportion_ci(confidence, "exact")
    return float(found.low), float(found.high)


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
