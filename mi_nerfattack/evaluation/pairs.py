"""Two looks, environments or methods compared by drives that are otherwise equal.

Drives are paired by scenario, seed and start. An attack, of one scenario and seed, is
what counts as one: its drives are averaged first, since starts tell nothing about other
attacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.summary import (
    DEPARTED_S,
    Interval,
    interquartile_mean,
    interval,
    share_interval,
)


@dataclass(frozen=True)
class Effect:
    """By how much a figure is larger on one side than on the other.

    Attributes:
        attacks: that were compared, n of all intervals.
        drives: pairs of drives whose means they are; several drives of one start and
            side, such as those with random textures, count as one.
        unpaired: starts of either side without a partner, which were left out.
        seeds: least number of seeds of a scenario.
        one: mean of one side over the attacks.
        other: mean of the other side over the attacks.
        difference: mean of one side less the other.
        difference_ci95: over the attacks, see `summary.interval`; None for few.
        iqm: interquartile mean of the differences.
        iqm_ci95: over the attacks; None for few attacks, and where too few differences
            differ.
        ratio: of the means; None where a value of the other side is 0 or less.
        ratio_ci95: over the attacks; None for few attacks, and without a ratio.
        spread: standard deviation of the difference from seed to seed, pooled over the
            scenarios; None where none has two seeds.
    """

    attacks: int
    drives: int
    unpaired: int
    seeds: int
    one: float
    other: float
    difference: float
    difference_ci95: Interval
    iqm: float
    iqm_ci95: Interval
    ratio: float | None
    ratio_ci95: Interval
    spread: float | None


@dataclass(frozen=True)
class Departures:
    """How many attacks depart on either side.

    Attributes:
        both: number of attacks that depart on both sides.
        one: number of attacks that depart on one side alone.
        other: number of attacks that depart on the other side alone.
        neither: number of attacks that depart on no side.
        one_ci95: of the share on one side (Wilson); None for few attacks.
        other_ci95: of the share on the other side.
        p_value: chance of a split between `one` and `other` as uneven as this, were
            the sides equal (McNemar's exact test, two-sided); None where both are 0.
    """

    both: int
    one: int
    other: int
    neither: int
    one_ci95: Interval
    other_ci95: Interval
    p_value: float | None


def compare(
    one: pd.DataFrame, other: pd.DataFrame, figure: str, seed: int = 0
) -> Effect:
    """Compare a figure of paired drives.

    Args:
        one: drives of one environment and case, with `scenario`, `seed`, `run` and
            `start`, as of `metrics.drives_of_run`.
        other: as `one`.
        figure: name of a column.
        seed: of the resampling.

    Raises:
        InputError: a side mixes environments or cases, a figure is missing or not
            finite, or no drives are paired.
    """
    scenarios, first, second, drives, unpaired = _paired(one, other, figure)
    difference = first - second
    counts = [scenarios.count(name) for name in set(scenarios)]
    means = first.mean(), second.mean()
    is_positive = bool((second > 0).all())
    return Effect(
        attacks=len(scenarios),
        drives=drives,
        unpaired=unpaired,
        seeds=min(counts),
        one=float(means[0]),
        other=float(means[1]),
        difference=float(difference.mean()),
        difference_ci95=interval(np.mean, (difference,), seed),
        iqm=float(interquartile_mean(difference)),
        iqm_ci95=interval(interquartile_mean, (difference,), seed),
        ratio=float(means[0] / means[1]) if is_positive else None,
        ratio_ci95=interval(_ratio, (first, second), seed, positive=True)
        if is_positive
        else None,
        spread=_spread(scenarios, difference),
    )


def compare_departures(
    one: pd.DataFrame,
    other: pd.DataFrame,
    figure: str = "wheel_out_s",
    least: float = DEPARTED_S,
) -> Departures:
    """Compare how many attacks depart, by paired drives.

    Args:
        one: as of :func:`compare`.
        other: as `one`.
        figure: name of the column of the departure.
        least: an attack departs whose mean figure is so large.

    Raises:
        InputError: as :func:`compare`.
    """
    import scipy.stats  # it takes a second

    _, first, second, _, _ = _paired(one, other, figure)
    a, b = first >= least, second >= least
    one_alone, other_alone = int((a & ~b).sum()), int((b & ~a).sum())
    total, differing = len(a), one_alone + other_alone
    p_value = None
    if differing:
        p_value = float(scipy.stats.binomtest(one_alone, differing).pvalue)
    return Departures(
        both=int((a & b).sum()),
        one=one_alone,
        other=other_alone,
        neither=int((~a & ~b).sum()),
        one_ci95=share_interval(int(a.sum()), total),
        other_ci95=share_interval(int(b.sum()), total),
        p_value=p_value,
    )


def _paired(
    one: pd.DataFrame, other: pd.DataFrame, figure: str
) -> tuple[list[str], np.ndarray, np.ndarray, int, int]:
    """Return the scenario of each attack and the means (n,) of both sides.

    Also how many starts were paired, and how many of either side were left out.
    """
    first, second = _by_start(one, figure), _by_start(other, figure)
    both = sorted(first.keys() & second.keys())
    if not both:
        raise InputError(
            f"no drives to pair: {len(first)} starts on one side, {len(second)} on the "
            "other, and none of equal scenario, seed and start"
        )
    rows: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for key in both:
        rows.setdefault(key[:2], []).append((first[key], second[key]))
    means = np.array([np.mean(pairs, axis=0) for pairs in rows.values()])
    unpaired = len(first.keys() ^ second.keys())
    return [name for name, _ in rows], means[:, 0], means[:, 1], len(both), unpaired


def _by_start(side: pd.DataFrame, figure: str) -> dict[tuple[str, int, int], float]:
    """Return the mean figure by scenario, seed and start."""
    if figure not in side:
        raise InputError(f"no column {figure}; there are {', '.join(side.columns)}")
    values = side[figure].to_numpy(float, na_value=np.nan)
    wrong = ~np.isfinite(values)
    again = side.duplicated(["scenario", "seed", "run"]).to_numpy()
    kinds = sorted(set(side["environment"] + " / " + side["case"]))
    if len(kinds) > 1:
        raise InputError(f"one side has drives of {', '.join(kinds)}; give one kind")
    if wrong.any() or again.any():
        row = side.iloc[int((wrong | again).argmax())]
        where = f"{row.scenario}, seed {row.seed}, run {row.run}"
        if again.any():
            raise InputError(f"{where}: twice on one side; give one method at a time")
        value = values[wrong][0]
        raise InputError(f"{where}: {figure} is {value}; give a finite number")
    figures: dict[tuple[str, int, int], list[float]] = {}
    starts = zip(side["scenario"], side["seed"], side["start"], strict=True)
    for key, value in zip(starts, values.tolist(), strict=True):
        figures.setdefault(key, []).append(value)
    return {key: float(np.mean(own)) for key, own in figures.items()}


def _ratio(one: np.ndarray, other: np.ndarray, axis: int = -1) -> Any:
    return one.mean(axis) / other.mean(axis)


def _spread(scenarios: Sequence[str], values: np.ndarray) -> float | None:
    """Return the standard deviation within scenarios, pooled."""
    names = np.array(scenarios)
    groups = [values[names == name] for name in np.unique(names)]
    freedom = sum(len(group) - 1 for group in groups)
    squares = sum(((group - group.mean()) ** 2).sum() for group in groups)
    return float(np.sqrt(squares / freedom)) if freedom else None
