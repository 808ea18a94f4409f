"""The findings about `vary`: what attacks keep in other light, and what parts give."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from bench.studies.attack import is_majority
from bench.studies.charts import draw_heat, draw_searches
from bench.studies.content import (
    ERROR,
    Finding,
    ends_cell,
    geometric_interval,
    with_labels,
)
from mi_nerfattack.evaluation.summary import Interval
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.deployment import SURROGATE

PLAIN, VARY = "plain", "vary"
#: An environment and a condition.
Where = tuple[str, str]
_OTHER_LIGHT = 0.6  # is the aim where it is not day
#: Aims by day, of bench/light.toml: shares of the surrogate's error.
AIMS = {
    "mitsuba": 0.9,
    "mujoco": 0.85,
    "mitsuba_built_in": 0.7,
    "mujoco_built_in": 0.7,
}

NONE, ALL = "nothing", "all parts"
#: What varies, by method of bench/vary_parts.toml.
VARIATIONS = {
    "none": NONE,
    "light": "light",
    "camera": "camera",
    "vehicle": "vehicle",
    "all": ALL,
}


_OF_LIGHT = (
    "The aim is the least share that `vary` should keep. We set the aims before the "
    "first result.",
    "In `mujoco`, another model moves the car: it stands on wheels, and its steering "
    "lags.",
    "All rows have the same attacks, so the rows are not independent. The light of the "
    "scene falls on the objects in the `built_in` rows only.",
)
_HEAD_OF_LIGHT = (
    *("environment", "condition", "aim", "`vary` keeps", "95 % interval", "floor"),
    *("`plain` keeps", "95 % interval", "`vary` to `plain`", "95 % interval"),
)


def light(drives: pd.DataFrame) -> Finding:
    """Compare attacks with and without `vary`, in each environment and condition."""
    logs, without = (
        _errors(drives, case).map(math.log) for case in (ATTACK, NO_OBJECT)
    )
    base = logs[SURROGATE, "day"]
    log_shares = logs.sub(base, axis=0).drop(columns=[(SURROGATE, "day")])
    shares, of_plain = _means(log_shares, VARY), _means(log_shares, PLAIN)
    bare, gains = _means(without.sub(base, axis=0), VARY), _gains(logs)
    ratios = {place: math.exp(own.mean()) for place, own in _differences(logs).items()}
    ends, ends_of_plain = _ends(log_shares, VARY), _ends(log_shares, PLAIN)
    aims = {(x, y): AIMS[x] if y == "day" else _OTHER_LIGHT for x, y in shares}
    rows = []
    for place, share in shares.items():
        cells = [
            *(f"{aims[place]:.2f}", f"{share:.2f}", ends_cell(ends.get(place), 2)),
            *(_cell(bare.get(place)), _cell(of_plain.get(place))),
            *(ends_cell(ends_of_plain.get(place), 2), _cell(ratios.get(place))),
            ends_cell(gains.get(place), 2),
        ]
        rows.append([*place, *cells])
    missed = [f"`{x}` {y}" for (x, y), aim in aims.items() if shares[x, y] < aim]
    reached = sum(of_plain[place] >= aims[place] for place in of_plain)
    known = list(filter(None, map(gains.get, shares)))
    helps, harms = sum(low > 1 for low, _ in known), sum(high < 1 for _, high in known)
    heat: Any = pd.Series(shares).unstack(sort=False)
    count, met = len(shares), len(shares) - len(missed)
    of_method = with_labels(drives).groupby("method")["attack"].nunique()
    attacks = " and ".join(
        f"{of_method.get(name, 0)} attacks with `{name}`" for name in (VARY, PLAIN)
    )
    return Finding(
        title=f"In {count} environments and lights, attacks with `vary` keep "
        f"{min(shares.values()):.2f} to {max(shares.values()):.2f} of their error; "
        f"it helps in {helps}",
        sentences=(
            "`vary` searches with light, camera and vehicle that differ from start to "
            "start. `plain` searches with those of the capture. What an attack keeps "
            "is its error in the environment, divided by its error in the surrogate by "
            "day (geometric mean over places with one start each). The floor is the "
            "same with the error without objects and the attack of `vary`. The table "
            f"has {attacks}.",
            f"`vary` reaches the aim in {met} of {count} rows"
            + (f", and misses it in {', '.join(missed)}. " if missed else ". ")
            + f"`plain` reaches the aim in {reached} rows. The 95 % intervals are "
            f"wide: all of the interval reaches the aim in {_sure(ends, aims)} "
            f"rows with `vary` and in {_sure(ends_of_plain, aims)} with `plain`.",
            "`vary` helps where the 95 % interval of its error, divided by that of "
            f"`plain`, lies above 1. It does so in {helps} rows. It lies below 1 in "
            f"{harms}, and contains 1 in the others, which shows neither help nor harm."
            if gains
            else "No place has an attack of both kinds, so the last column is empty.",
        ),
        head=_HEAD_OF_LIGHT,
        rows=rows,
        draw=lambda figure: draw_heat(figure, heat),
        pandas='by = [drives.attack.str.split("-").str[-3], "case", "environment"]\n'
        'print(drives.groupby([*by, "condition"]).cross_track_mean_m.mean().unstack())',
        threats=(*_OF_LIGHT, *_farther(logs), _stayed(drives, log_shares)),
    )


def _sure(ends: Mapping[Where, Interval], aims: Mapping[Where, float]) -> int:
    """Count the places whose whole interval reaches the aim."""
    return sum(one is not None and one[0] >= aims[where] for where, one in ends.items())


def _farther(logs: Any) -> Iterator[str]:
    """Yield where one of both moves the car farther, by the rule that counts places."""
    differences = _differences(logs)
    for name, signed in ((PLAIN, -differences), (VARY, differences)):
        counts = (signed > 0).sum()
        listed = ", ".join(
            f"`{x}` {y} ({count} of {len(signed)})"
            for (x, y), count in counts.items()
            if is_majority(int(count), len(signed))
        )
        if listed:
            yield (
                "By the [rule that counts places](index.md#the-rules), "
                f"`{name}` moves the car farther in {listed}."
            )


def _stayed(drives: pd.DataFrame, log_shares: pd.DataFrame) -> str:
    """Say how much of the least share by day is due to cars that stay in their lane."""
    own: Any = log_shares.loc[VARY]
    by_day = own.xs("day", axis=1, level="condition")
    where = by_day.mean().idxmin()
    out: Any = _errors(drives, ATTACK, "departed").loc[VARY].astype(bool)
    left, there = out[SURROGATE, "day"], out[where, "day"]
    stays = left & ~there
    others = math.exp(by_day[where][~stays].mean())
    is_each = 0 < stays.sum() == left.sum()
    few = f"at all {left.sum()}" if is_each else f"at {stays.sum()}"
    return (
        f"A few places decide about a mean: with `vary`, the car leaves the lane at "
        f"{left.sum()} places in the surrogate by day. In `{where}` by day, it stays "
        f"in the lane {few} of them. The attacks at the other "
        f"{(~stays).sum()} places keep {others:.2f} there; we looked at this share "
        "after we had the rows."
    )


def _errors(drives: pd.DataFrame, case: str, value: str = ERROR) -> pd.DataFrame:
    """Return a value of a case by method, route and seed, and where it drives."""
    own = with_labels(drives[drives["case"] == case])
    rows, columns = ["method", "route", "seed"], ["environment", "condition"]
    return own.pivot_table(value, rows, columns, sort=False)


def _means(logs: pd.DataFrame, method: str) -> dict[Where, float]:
    """Return the geometric means of a method over its places; none without any."""
    if method not in logs.index.get_level_values("method"):
        return {}
    own: Any = logs.loc[method]
    return {place: math.exp(mean) for place, mean in own.mean().items()}


def _differences(logs: pd.DataFrame) -> Any:
    """Return the logarithm of the ratio of `vary` to `plain` at each place."""
    methods = set(logs.index.get_level_values("method"))
    if not {PLAIN, VARY} <= methods:
        return pd.DataFrame()
    return (logs.loc[VARY] - logs.loc[PLAIN]).dropna()


def _gains(logs: pd.DataFrame) -> dict[Where, Interval]:
    """Return the interval of the ratio of `vary` to `plain`, paired by place."""
    return _intervals(_differences(logs))


def _cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _ends(log_shares: pd.DataFrame, method: str) -> dict[Where, Interval]:
    """Return the intervals of the geometric means of a method over its places."""
    known = method in log_shares.index.get_level_values("method")
    return _intervals(log_shares.loc[method].dropna()) if known else {}


def _intervals(logs: Any) -> dict[Where, Interval]:
    """Return the interval of the geometric mean of each column."""
    return {place: geometric_interval(own.to_numpy()) for place, own in logs.items()}


def vary_parts(drives: pd.DataFrame) -> Finding:
    """Compare each part with the attack that varies nothing."""
    own = with_labels(drives[drives["case"] == ATTACK])
    own = own.assign(part=own["method"].map(VARIATIONS), log=own[ERROR].map(math.log))
    named = [name for name in VARIATIONS.values() if name in set(own["part"])]
    where = ["environment", "condition"]
    logs: Any = own.pivot_table("log", where, "part", sort=False)[named]
    gains = logs.drop(columns=NONE).sub(logs[NONE], axis=0)
    means, places = gains.mean().map(math.exp), own[["route", "seed"]].drop_duplicates()
    errors: Any = own.pivot_table("log", "part", "route", sort=False).loc[named]
    # By which factor the parts differ at a place: one place can decide their order
    spreads = (errors.max() - errors.min()).map(math.exp)
    least, most = spreads.sort_values().iloc[-2:]
    route = spreads.idxmax()
    elsewhere = errors.drop(columns=route)
    without = elsewhere.sub(elsewhere.loc[NONE]).mean(axis=1).map(math.exp).drop(NONE)
    rows = [
        [*place, f"{math.exp(logs.loc[place, NONE]):.3f}"]
        + [f"{math.exp(gain):.2f}" for gain in gains.loc[place]]
        for place in logs.index
    ]
    best, pairs = means.drop(ALL).idxmax(), len(logs)
    above = [f"{(gains[name] > 0).sum()} (`{name}`)" for name in gains.columns]
    return Finding(
        title=f"{len(places)} places cannot show which part of `vary` helps: `{best}` "
        f"has the largest mean ratio, {means[best]:.2f}",
        sentences=(
            "The error of an attack that varies nothing is multiplied by "
            f"{_listed(means)}, as a geometric mean of {pairs} pairs of environment "
            "and light.",
            "The ratio is above 1, so the part makes the attack stronger, in "
            f"{', '.join(above[:-1])} and {above[-1]} of these pairs.",
            f"On `{route}`, the geometric mean errors of the parts differ by a factor "
            f"of {most:.1f}, and on the other routes by at most {least:.1f}. Without "
            f"`{route}`, the ratios are {_listed(without)}.",
        ),
        head=["environment", "condition", "nothing (geometric mean, m)"]
        + [f"{name} (ratio)" for name in gains.columns],
        rows=rows,
        draw=lambda figure: draw_searches(figure, errors.map(math.exp)),
        pandas="attacks = drives.query(\"case == 'attack'\").copy()\n"
        'print(attacks.groupby(["attack", "environment"]).cross_track_mean_m.mean())',
    )


def _listed(ratios: Any) -> str:
    """Return ratios as words."""
    *first, last = (f"{x:.2f} (`{name}`)" for name, x in ratios.items())
    return f"{', '.join(first)} and {last}"
