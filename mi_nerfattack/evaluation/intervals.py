"""Means of measured figures and their 95 % confidence intervals."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

RESAMPLES = 9999

#: Ends of an interval; None where there is none.
Interval = list[float] | None


def share_interval(count: int, total: int) -> list[float]:
    """Return the lower and upper end of a share's interval (Wilson).

    Args:
        count: how often something happened.
        total: of how many times, at least 1.
    """
    import scipy.stats  # it takes a second

    interval = scipy.stats.binomtest(count, total).proportion_ci(method="wilson")
    return [float(interval.low), float(interval.high)]


def mean_interval(values: np.ndarray, seed: int) -> Interval:
    """Return the interval of the mean, see :func:`bootstrap_interval`.

    Args:
        values: (n,), a number for each run.
        seed: of the resampling.
    """
    return bootstrap_interval(np.mean, (values,), seed)


def interquartile_mean(values: np.ndarray, axis: int = -1) -> Any:
    """Return the mean of what lies between the quartiles; of less than 4, the mean.

    A quarter of the values, rounded down, is left out at either end.

    Args:
        values: (..., n) along the axis.
        axis: to be averaged.
    """
    import scipy.stats

    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def bootstrap_interval(
    statistic: Callable[..., Any], samples: tuple[np.ndarray, ...], seed: int
) -> Interval:
    """Return an interval by resampling, bias-corrected and accelerated (BCa).

    Args:
        statistic: of samples, along the keyword `axis`.
        samples: (n,) each; several are paired, and resampled together.
        seed: of the resampling.

    Returns:
        Its lower and upper end, which are equal where all resamples give one value.
        None where there is none: for n = 1, and where leaving out any one of n gives
        one value, though they differ, as the interquartile mean of 0, 0, 0, 0, 1.

    Source: Efron, JASA 1987; `scipy.stats.bootstrap`.
    """
    if len(samples[0]) < 2:
        return None
    import scipy.stats

    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)
        found = scipy.stats.bootstrap(
            samples,
            statistic,
            confidence_level=0.95,
            n_resamples=RESAMPLES,
            paired=len(samples) > 1,
            method="BCa",
            rng=np.random.default_rng(seed),
        )
    resampled = found.bootstrap_distribution
    if resampled.min() == resampled.max():
        return [float(resampled[0])] * 2
    ends = [float(end) for end in found.confidence_interval]
    return None if np.isnan(ends).any() else ends
