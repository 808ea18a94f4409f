"""Two looks, environments or methods compared by drives that are otherwise equal.

Drives are paired by scenario, seed and start. An attack, of one scenario and seed, is
what counts as one: its drives are averaged first, since starts tell nothing about other
attacks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.intervals import (
    Interval,
    bootstrap_interval,
    interquartile_mean,
    mean_interval,
    share_interval,
)
from mi_nerfattack.rollout.drive import OWN
from mi_nerfattack.scenario.deployment import SURROGATE

#: An attack counts as departed from so many seconds with a wheel out on, on average.
DEPARTED_S = 1.0


@dataclass(frozen=True)
class Outcome:
    """What a drive came to.

    Attributes:
        scenario: what was attacked; the same for all seeds, methods and looks.
        seed: of the attack.
        environment: name.
        case: what objects showed.
        run: index among the drives of all these.
        start: index of the initial state.
        figures: numbers by name, such as ``wheel_out_s``.
    """

    scenario: str
    seed: int
    environment: str
    case: str
    run: int
    start: int
    figures: Mapping[str, float]


@dataclass(frozen=True)
class Effect:
    """By how much a figure is larger on one side than on the other.

    Attributes:
        attacks: that were compared, n of all intervals.
        drives: pairs of drives whose means they are; several of one start and side,
            such as random looks, count as one.
        unpaired: starts of either side without a partner, which were left out.
        seeds: fewest of a scenario.
        one: mean of one side over the attacks.
        other: of the other one.
        difference: mean of one side less the other.
        difference_ci95: BCa over the attacks; None for a single one.
        iqm: interquartile mean of the differences.
        iqm_ci95: likewise; None also where too few differences differ.
        ratio: of the means; None where one of the other side's is 0 or less.
        ratio_ci95: likewise; None without a ratio or for a single attack.
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
        both: attacks that do on both.
        one: on this side alone.
        other: on the other one alone.
        neither: on none.
        one_ci95: of the share on this side (Wilson).
        other_ci95: on the other one.
        p_value: of a split of those on one side alone as uneven as this, were the
            sides equal (McNemar's exact test, two-sided); 1 where there are none.
    """

    both: int
    one: int
    other: int
    neither: int
    one_ci95: list[float]
    other_ci95: list[float]
    p_value: float


def over_attacks(
    errors_m: np.ndarray, wheel_out_s: np.ndarray, seed: int
) -> dict[str, Any]:
    """Summarise attacks, each of which counts once.

    Args:
        errors_m: (n,), the mean error of each, over its drives.
        wheel_out_s: (n,), mean seconds with a wheel out.
        seed: of the resampling.

    Returns:
        how many ``attacks``; mean error, its standard deviation (None of one) and BCa
        interval; mean seconds; how many are out for `DEPARTED_S`, with Wilson's
        interval of their share.
    """
    count, out = len(errors_m), int((wheel_out_s >= DEPARTED_S).sum())
    return {
        "attacks": count,
        "cross_track_mean_m": float(errors_m.mean()),
        "cross_track_sd_m": float(errors_m.std(ddof=1)) if count > 1 else None,
        "cross_track_mean_ci95_m": mean_interval(errors_m, seed),
        "wheel_out_s": float(wheel_out_s.mean()),
        "attacks_out": out,
        "attacks_out_rate_ci95": share_interval(out, count),
    }


def outcomes(
    document: Mapping[str, Any],
    environment: str,
    case: str,
    scenario: str | None = None,
) -> list[Outcome]:
    """Return the drives of one environment and case of a run.

    Args:
        document: that ``metrics.json`` of the run holds.
        environment: driven in, in a closed loop.
        case: of the drives.
        scenario: what was attacked; by default its scenario's name.

    Raises:
        InputError: there are no such drives.
    """
    [environments] = document["routes"].values()
    runs = (environments.get(environment, {}).get(case) or {}).get("per_run")
    if not runs:
        known = ", ".join(
            f"{e} / {c}" for e, cases in environments.items() for c in cases
        )
        raise InputError(f"{environment} / {case}: no such drives; there are: {known}")
    starts = environments[SURROGATE][OWN]["n"]
    name = document["scenario"]["name"] if scenario is None else scenario
    about = name, document["seed"], environment, case
    return [Outcome(*about, row["run"], row["run"] % starts, row) for row in runs]


def compare(
    one: Iterable[Outcome], other: Iterable[Outcome], figure: str, seed: int = 0
) -> Effect:
    """Compare a figure of paired drives.

    Args:
        one: of one environment and case.
        other: likewise.
        figure: its name.
        seed: of the resampling.

    Raises:
        InputError: a side mixes environments or cases, a figure is missing or not
            finite, or no drives are paired.
    """
    keys, first, second, drives, unpaired = _paired(one, other, figure)
    difference = first - second
    scenarios = [name for name, _ in keys]
    counts = [scenarios.count(name) for name in set(scenarios)]
    means = first.mean(), second.mean()
    is_positive = bool((second > 0).all())
    return Effect(
        attacks=len(keys),
        drives=drives,
        unpaired=unpaired,
        seeds=min(counts),
        one=float(means[0]),
        other=float(means[1]),
        difference=float(difference.mean()),
        difference_ci95=mean_interval(difference, seed),
        iqm=float(interquartile_mean(difference)),
        iqm_ci95=bootstrap_interval(interquartile_mean, (difference,), seed),
        ratio=float(means[0] / means[1]) if is_positive else None,
        ratio_ci95=bootstrap_interval(_ratio, (first, second), seed)
        if is_positive
        else None,
        spread=_spread(scenarios, difference),
    )


def compare_departures(
    one: Iterable[Outcome],
    other: Iterable[Outcome],
    figure: str = "wheel_out_s",
    least: float = DEPARTED_S,
) -> Departures:
    """Compare how many attacks depart, by paired drives.

    Args:
        one: of one environment and case.
        other: likewise.
        figure: that tells.
        least: an attack departs whose mean figure is so large.

    Raises:
        InputError: as :func:`compare`.
    """
    import scipy.stats  # it takes a second

    _, first, second, _, _ = _paired(one, other, figure)
    a, b = first >= least, second >= least
    alone = int((a & ~b).sum()), int((b & ~a).sum())
    total, differing = len(a), sum(alone)
    p_value = scipy.stats.binomtest(alone[0], differing).pvalue if differing else 1.0
    return Departures(
        int((a & b).sum()),
        *alone,
        int((~a & ~b).sum()),
        share_interval(int(a.sum()), total),
        share_interval(int(b.sum()), total),
        float(p_value),
    )


def _paired(
    one: Iterable[Outcome], other: Iterable[Outcome], figure: str
) -> tuple[list[tuple[str, int]], np.ndarray, np.ndarray, int, int]:
    """Return attacks, means (n,) of both sides, pairs of drives, starts left out."""
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
    return list(rows), means[:, 0], means[:, 1], len(both), unpaired


def _by_start(
    side: Iterable[Outcome], figure: str
) -> dict[tuple[str, int, int], float]:
    """Return the mean figure by scenario, seed and start."""
    found: dict[tuple[str, int, int], list[float]] = {}
    kinds: set[str] = set()
    seen: set[str] = set()
    for drive in side:
        where = f"{drive.scenario}, seed {drive.seed}, run {drive.run}"
        value = drive.figures.get(figure)
        if value is None or not np.isfinite(value):
            raise InputError(f"{where}: {figure} is {value}; give a finite number")
        key = drive.scenario, drive.seed, drive.start
        found.setdefault(key, []).append(float(value))
        kinds.add(f"{drive.environment} / {drive.case}")
        if len(kinds) > 1:
            listed = ", ".join(sorted(kinds))
            raise InputError(f"one side has drives of {listed}; give those of one")
        if where in seen:
            raise InputError(f"{where}: twice on one side; give one method at a time")
        seen.add(where)
    return {key: float(np.mean(values)) for key, values in found.items()}


def _ratio(one: np.ndarray, other: np.ndarray, axis: int = -1) -> Any:
    return one.mean(axis) / other.mean(axis)


def _spread(scenarios: Sequence[str], values: np.ndarray) -> float | None:
    """Return the standard deviation within scenarios, pooled."""
    names = np.array(scenarios)
    groups = [values[names == name] for name in np.unique(names)]
    freedom = sum(len(group) - 1 for group in groups)
    squares = sum(((group - group.mean()) ** 2).sum() for group in groups)
    return float(np.sqrt(squares / freedom)) if freedom else None
