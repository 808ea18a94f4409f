"""The finding about transfer: what attacks keep in other environments."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from bench.studies.charts import draw_heat
from bench.studies.content import ERROR, HALF, Finding, ends_cell, with_labels
from mi_nerfattack.evaluation.summary import interval
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
    ends = {
        name: np.exp(bounds).tolist()
        for name in by_day.index
        if (bounds := interval(np.mean, (logs[name]["day"].to_numpy(),), 0)) is not None
    }
    above = sum(low > HALF for low, _ in ends.values())
    lost = sum(high < HALF for _, high in ends.values())
    count = len(by_day)
    title = (
        f"By day, the best attacks keep over half of their error in {above} of {count} "
        f"environments, under half in {lost}"
    )
    return Finding(
        title=title,
        sentences=(
            f"By day, the error with the attack is {by_day.max():.2f} times the error "
            f"in the surrogate in `{by_day.idxmax()}`, and {by_day.min():.2f} times in "
            f"`{by_day.idxmin()}`.",
            f"In {count - above - lost} environments, the 95 % interval of this ratio "
            "contains one half.",
            f"These are geometric means over {len(logs)} places with "
            f"{drives['attack'].nunique()} attacks, and attacks at one place count as "
            "one value.",
        ),
        head=[
            *("environment, by day", "error to the surrogate's", "95 % interval"),
            "the same without objects",
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
            "[transfer](../../howto/transfer.md) explains the labels.",
        ),
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
