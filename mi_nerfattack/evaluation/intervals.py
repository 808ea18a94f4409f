"""Confidence intervals of measured figures, 95 %."""

from __future__ import annotations

import numpy as np

RESAMPLES = 9999


def share_interval(count: int, total: int) -> list[float]:
    """Return the lower and upper end of a share's interval (Wilson).

    Args:
        count: how often something happened.
        total: of how many times, at least 1.
    """
    import scipy.stats  # it takes a second

    interval = scipy.stats.binomtest(count, total).proportion_ci(method="wilson")
    return [float(interval.low), float(interval.high)]


def mean_interval(means: np.ndarray, seed: int) -> list[float] | None:
    """Return the interval of the mean over runs (percentile bootstrap).

    Args:
        means: (n,), a number for each run.
        seed: of the resampling.

    Returns:
        Its lower and upper end; None for a single run, which has no spread.
    """
    if len(means) < 2:
        return None
    import scipy.stats  # it takes a second

    # Percentile: the bias-corrected interval is undefined for equal runs.
    interval = scipy.stats.bootstrap(
        (means,),
        np.mean,
        confidence_level=0.95,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return [float(interval.low), float(interval.high)]
