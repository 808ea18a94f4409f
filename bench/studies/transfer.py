"""The finding about transfer: what attacks keep in other environments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

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
    bare = empty["day"].reindex(by_day.index)
    own = {name: logs[name]["day"] for name in by_day.index}
    ends = {name: geometric_interval(one.to_numpy()) for name, one in own.items()}
    above, lost = _above(own), sum(one[1] < HALF for one in ends.values() if one)
    count = len(by_day)
    title = (
        f"By day, the best attacks keep over half of their error in {above} of {count} "
        f"environments, under half in {lost}"
    )
    return Finding(
        title=title,
        sentences=(
            "The mean distance from the lane centre with the attack, divided by the "
            f"same in the surrogate, is by day {_range(by_day)}.",
            f"In {count - above - lost} environments, the 95 % interval of this ratio "
            "contains one half.",
            f"The ratios are geometric means over {len(logs)} places with "
            f"{drives['attack'].nunique()} attacks, and attacks at one place count as "
            "one value.",
        ),
        head=[
            *("environment, by day", "error, divided by the surrogate's"),
            *("95 % interval", "the same without objects"),
        ],
        rows=[
            [str(n), f"{x:.2f}", ends_cell(ends.get(n), 2), f"{y:.2f}"]
            for (n, x), y in zip(by_day.items(), bare, strict=True)
        ],
        draw=lambda figure: draw_heat(figure, heat),
        pandas="own = drives.query(\"case == 'attack' and condition == 'day'\")\n"
        'print(own.pivot_table("cross_track_mean_m", "environment", "route"))',
        threats=(
            "A grey cell of the chart means: no drive exists. "
            "[transfer](../../reference/transfer.md) explains the labels.",
            _size(drives),
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
        f"{one.min():.2f} to {one.max():.2f} for {name} objects"
        for name, one in sides.items()
        if len(one)
    ]
    return " and ".join(words)


def _size(drives: pd.DataFrame) -> str:
    """Say how large the errors are of which the page gives shares."""
    by_day = drives[(drives["condition"] == "day") & (drives["case"] == ATTACK)]
    own = by_day[by_day["environment"] == SURROGATE]
    left = by_day.groupby("environment", sort=False)["departed"].sum()
    counts = ", ".join(f"`{name}` {count}" for name, count in left.items())
    return (
        f"The median error in the surrogate is {own[ERROR].median():.2f} m by day. Of "
        f"the {len(own)} drives in each environment, these leave the lane: {counts}."
    )


def _decisive_places(logs: Mapping[str, pd.Series], above: int) -> Iterator[str]:
    """Yield the places without which the title would count other environments."""
    places = next(iter(logs.values())).index
    for route, seed in places if len(places) > FEWEST else ():
        count = _above({name: one.drop((route, seed)) for name, one in logs.items()})
        if count != above:
            yield (
                f"One place decides about the title: without {route} {seed}, the "
                f"attacks keep over half in {count} of {len(logs)} environments."
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
