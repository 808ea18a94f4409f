"""The summary of a table of drives, by any of its columns, with intervals."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import pandas as pd

RESAMPLES = 9999
#: Fewer values, each independent, have no interval.
FEWEST = 5
#: Up to so many have a t interval, more a bootstrap: docs/explain/intervals.md has
#: the coverage of both.
FEW = 15
#: Largest standard error of a logarithm for a t interval of it: with more, as of values
#: that are all or nothing, such an interval reaches over orders of magnitude.
LOGARITHM = 0.5

#: Ends of a 95 % interval; None where there is none.
Interval = list[float] | None


def share_interval(count: int, total: int) -> Interval:
    """Return the lower and upper end of a share's interval (Wilson).

    Args:
        count: how often something happened.
        total: of how many times; None is returned for less than `FEWEST`.
    """
    return [*_wilson(count, total)] if total >= FEWEST else None


@cache
def _wilson(count: int, total: int) -> tuple[float, float]:
    import scipy.stats  # it takes a second

    interval = scipy.stats.binomtest(count, total).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: np.ndarray, seed: int) -> Interval:
    """Return the interval of the mean of positive numbers, see :func:`interval`.

    Args:
        values: (n,), a number for each run, at least 0.
        seed: of the resampling.
    """
    return interval(np.mean, (values,), seed, positive=True)


def interquartile_mean(values: np.ndarray, axis: int = -1) -> Any:
    """Return the mean of what lies between the quartiles; of less than 4, the mean.

    A quarter of the values, rounded down, is left out at either end.

    Args:
        values: (..., n) along the axis.
        axis: to be averaged.
    """
    import scipy.stats

    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def interval(
    statistic: Callable[..., Any],
    samples: tuple[np.ndarray, ...],
    seed: int,
    positive: bool = False,
) -> Interval:
    """Return the 95 % interval of a statistic of n independent values.

    Up to `FEW` values, it is a t interval with the jackknife's standard error, which
    for a mean is Student's own. Beyond, it is a bootstrap, bias-corrected and
    accelerated (BCa), whose coverage is too low for few values.

    Args:
        statistic: of samples, along the keyword `axis`.
        samples: (n,) each; several are paired, and resampled together.
        seed: of the resampling.
        positive: whether the statistic is positive; the t interval is then one of its
            logarithm if the error of the logarithm is `LOGARITHM` at most, and else
            ends at 0.

    Returns:
        Its lower and upper end, which are equal where all values are.
        None where there is none: for n < `FEWEST`, and where leaving out any one of n
        gives one value, though they differ, as the interquartile mean of
        0, 0, 0, 0, 1.

    Source: Tukey 1958; Efron, JASA 1987; `scipy.stats.bootstrap`.
    """
    count = len(samples[0])
    if count < FEWEST:
        return None
    value = float(statistic(*samples))
    if all(sample.min() == sample.max() for sample in samples):
        return [value] * 2
    if count > FEW:
        return _bootstrap(statistic, samples, seed)
    import scipy.stats

    left_out = np.array(
        [statistic(*(np.delete(s, k) for s in samples)) for k in range(count)]
    )
    quantile = float(scipy.stats.t.ppf(0.975, count - 1))
    if positive and left_out.min() > 0:
        error = _jackknife(np.log(left_out))
        if 0 < error <= LOGARITHM:
            factor = float(np.exp(quantile * error))
            return [value / factor, value * factor]
    if (error := _jackknife(left_out)) == 0:
        return None
    low, high = value - quantile * error, value + quantile * error
    return [max(low, 0.0) if positive else low, high]


def _jackknife(left_out: np.ndarray) -> float:
    """Return the standard error from statistics (n,) without one value each."""
    return float(np.sqrt((len(left_out) - 1) * left_out.var()))


def _bootstrap(
    statistic: Callable[..., Any], samples: tuple[np.ndarray, ...], seed: int
) -> Interval:
    """Return the BCa interval; arguments as of :func:`interval`."""
    import scipy.stats

    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)
        bootstrap = scipy.stats.bootstrap(
            samples,
            statistic,
            confidence_level=0.95,
            n_resamples=RESAMPLES,
            paired=len(samples) > 1,
            method="BCa",
            rng=np.random.default_rng(seed),
        )
    ends = [float(end) for end in bootstrap.confidence_interval]
    return None if np.isnan(ends).any() else ends


#: An attack counts as departed from so many seconds with a wheel out on, on average.
DEPARTED_S = 1.0
_ERROR, _OUT = "cross_track_mean_m", "wheel_out_s"
_LARGEST, _STEPS = "cross_track_max_m", "steps_departed"
#: Averaged over the drives of an attack, then over the attacks, where a table has them.
_MEANS = ("centre_out_s", "cross_track_total", "frames", "objective")
_USED = (_ERROR, _OUT, _LARGEST, _STEPS, *_MEANS, "departed")


def summary(
    table: pd.DataFrame, by: Sequence[str], once: Sequence[str], seed: int = 0
) -> pd.DataFrame:
    """Summarise drives by columns, with one row per group, in the order of the table.

    The columns of `once` name one attack. An attack counts once: its drives are
    averaged first, because its starts say nothing about other attacks. Columns of the
    result:

    - `attacks`, `drives`: how many;
    - `cross_track_mean_m`, `cross_track_sd_m`, `cross_track_mean_ci95_m`: mean error
      of the attacks, its standard deviation (NaN for one attack) and its interval
      (None for few attacks);
    - `cross_track_mean_worst_run_m`, `cross_track_max_m`: largest mean error of a
      drive, largest error of a step;
    - `wheel_out_s`, `centre_out_s`, `cross_track_total`, `frames`, `objective`: means;
    - `attacks_out`, `attacks_out_rate_ci95`: attacks whose drives have a wheel out for
      `DEPARTED_S` in the mean, and Wilson's interval of their share;
    - `steps_departed`: sum; `drives_departed`, `departure_rate_ci95`: drives that
      leave the lane, and Wilson's interval of their share (None for few attacks, and
      where an attack has several drives).

    Args:
        table: with `cross_track_mean_m`, `wheel_out_s` and `departed`; figures of
            other columns are left out where there is no such column.
        by: columns.
        once: columns.
        seed: of the resampling.
    """
    groups = table.groupby(list(by), sort=False, dropna=False).ngroup().to_numpy()
    units = table.groupby([*by, *once], sort=False, dropna=False).ngroup().to_numpy()
    columns = {name: table[name].to_numpy(float) for name in _USED if name in table}
    ends = np.cumsum(np.bincount(groups))[:-1]
    own = np.split(np.argsort(groups, kind="stable"), ends)  # rows by group
    summaries = [
        _figures({name: values[rows] for name, values in columns.items()}, unit, seed)
        for rows in own
        if len(unit := units[rows])
    ]
    labels = table.iloc[[rows[0] for rows in own if len(rows)]][list(by)]
    return pd.concat([labels.reset_index(drop=True), pd.DataFrame(summaries)], axis=1)


def _figures(
    columns: Mapping[str, np.ndarray], unit: np.ndarray, seed: int
) -> dict[str, Any]:
    """Summarise the drives of one group, each with the number of its attack."""
    attacks = [np.flatnonzero(unit == number) for number in dict.fromkeys(unit)]

    def means(name: str) -> np.ndarray:
        return np.array([columns[name][rows].mean() for rows in attacks])

    errors, out_s = means(_ERROR), means(_OUT)
    count, drives = len(attacks), len(unit)
    out, left = int((out_s >= DEPARTED_S).sum()), int(columns["departed"].sum())
    figures = {
        "attacks": count,
        "drives": drives,
        _ERROR: float(errors.mean()),
        "cross_track_sd_m": float(errors.std(ddof=1)) if count > 1 else np.nan,
        "cross_track_mean_ci95_m": mean_interval(errors, seed),
        "cross_track_mean_worst_run_m": float(columns[_ERROR].max()),
        _OUT: float(out_s.mean()),
        "attacks_out": out,
        "attacks_out_rate_ci95": share_interval(out, count),
        "drives_departed": left,
        # drives of one attack are not independent, however many there are
        "departure_rate_ci95": share_interval(left, drives)
        if count == drives
        else None,
    }
    figures |= {name: float(means(name).mean()) for name in _MEANS if name in columns}
    if _LARGEST in columns:
        figures[_LARGEST] = float(columns[_LARGEST].max())
    if _STEPS in columns:
        figures[_STEPS] = int(columns[_STEPS].sum())
    return figures
