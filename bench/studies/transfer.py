"""The finding about transfer: what attacks keep in other environments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from bench.studies.charts import draw_heat
from bench.studies.content import (
    ERROR,
    HALF,
    Finding,
    ends_cell,
    geometric_interval,
    with_labels,
)
from mi_nerfattack.evaluation.summary import FEWEST
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.deployment import SURROGATE


def transfer(drives: pd.DataFrame) -> Finding:
    """Compare each environment and condition with the surrogate by day."""
    logs, without = (_to_surrogate(drives, case) for case in (ATTACK, NO_OBJECT))
    heat, empty = (
        one.mean().map(math.exp).unstack(sort=False) for one in (logs, without)
    )
    by_day = heat["day"].drop(SURROGATE)
    bare: Any = empty["day"].reindex(by_day.index)
    own = {name: logs[name]["day"] for name in by_day.index}
    ends = {name: geometric_interval(one.to_numpy()) for name, one in own.items()}
    above, lost = _above(own), sum(one[1] < HALF for one in ends.values() if one)
    count = len(by_day)
    mean, out = _totals(drives)
    return Finding(
        title=f"By day, the best attacks keep {_range(by_day)} of their error",
        sentences=(
            "What an attack keeps is the mean distance from the lane centre, divided "
            "by the same in the surrogate by day. The table has geometric means over "
            f"{len(logs)} places with {drives['attack'].nunique()} attacks. Attacks at "
            "one place count as one value.",
            f"The 95 % interval lies above one half in {above} of {count} "
            f"environments, below one half in {lost}, and contains one half in "
            f"{count - above - lost}.",
            "The quotient of the mean errors over all attacks gives strong attacks "
            "more weight. In "
            f"`{mean.idxmin()}`, it is {mean.min():.2f}.",
        ),
        head=[
            *("environment, by day", "keeps", "95 % interval", "floor: no objects"),
            *("quotient of the mean errors", "drives out of the lane"),
        ],
        rows=[
            [str(n), f"{x:.2f}", ends_cell(ends.get(n), 2), f"{bare[n]:.2f}"]
            + [f"{mean[n]:.2f}", out[n]]
            for n, x in by_day.items()
        ],
        draw=lambda figure: draw_heat(figure, heat),
        pandas="own = drives.query(\"case == 'attack' and condition == 'day'\")\n"
        'print(own.pivot_table("cross_track_mean_m", "environment", "route"))',
        threats=(
            "A grey cell of the chart means: no drive exists. "
            "[transfer](../../reference/transfer.md) explains the labels.",
            f"The median error in the surrogate is {_median(drives):.2f} m by day, and "
            f"{out[SURROGATE]} drives leave the lane there.",
            *_decisive_places(own, above),
        ),
    )


def _above(logs: Mapping[str, pd.Series]) -> int:
    """Count the environments whose interval lies above `HALF`."""
    ends = [geometric_interval(one.to_numpy()) for one in logs.values()]
    return sum(one is not None and one[0] > HALF for one in ends)


def _range(by_day: pd.Series) -> str:
    """Return the least and the largest ratio of pasted and of built-in objects."""
    built = by_day.index.str.endswith("built_in")
    sides = {"pasted": by_day[~built], "built-in": by_day[built]}
    words = [
        f"{one.min():.2f} to {one.max():.2f} ({name})"
        for name, one in sides.items()
        if len(one)
    ]
    return ", ".join(words)


def _attacks_by_day(drives: pd.DataFrame) -> pd.DataFrame:
    return drives[(drives["condition"] == "day") & (drives["case"] == ATTACK)]


def _median(drives: pd.DataFrame) -> float:
    """Return the median error in the surrogate by day, metres."""
    own = _attacks_by_day(drives)
    return float(own[own["environment"] == SURROGATE][ERROR].median())


def _totals(drives: pd.DataFrame) -> tuple[Any, dict[Any, str]]:
    """Return the quotients of the mean errors, and the drives out, by environment."""
    by_environment = _attacks_by_day(drives).groupby("environment", sort=False)
    means, left = by_environment[ERROR].mean(), by_environment["departed"]
    out = {str(n): f"{own.sum()} of {len(own)}" for n, own in left}
    return means.drop(SURROGATE) / means[SURROGATE], out


def _decisive_places(logs: Mapping[str, pd.Series], above: int) -> Iterator[str]:
    """Yield the places without which another number of environments would count."""
    places = next(iter(logs.values())).index
    for route, seed in places if len(places) > FEWEST else ():
        count = _above({name: one.drop((route, seed)) for name, one in logs.items()})
        if count != above:
            yield (
                f"One place decides: without {route} {seed}, the 95 % interval lies "
                f"above one half in {count} of {len(logs)} environments."
            )


def _to_surrogate(drives: pd.DataFrame, case: str) -> pd.DataFrame:
    """Divide errors by the error with the attack in the surrogate by day.

    Returns:
        Mean logarithms of a place (row), by environment and condition.
    """
    rows, columns = ["route", "seed", "attack"], ["environment", "condition"]
    labelled = with_labels(drives)
    table, attacks = (
        labelled[labelled["case"] == name].pivot_table(ERROR, rows, columns, sort=False)
        for name in (case, ATTACK)
    )
    logs = table.div(attacks[SURROGATE]["day"], axis=0).map(math.log)
    return logs.groupby(["route", "seed"]).mean()
