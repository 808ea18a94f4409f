"""The finding about the parts of `vary`: what each one gives in other environments."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from bench.studies.charts import draw_searches
from bench.studies.content import ERROR, Finding, with_labels
from mi_nerfattack.rollout.drive import ATTACK

NONE, ALL = "nothing", "all parts"
#: What varies, by method of bench/vary_parts.toml.
VARIATIONS = {
    "none": NONE,
    "light": "light",
    "camera": "camera",
    "vehicle": "vehicle",
    "all": ALL,
}


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
    rows = [
        [*place, f"{math.exp(logs.loc[place, NONE]):.3f}"]
        + [f"{math.exp(gain):.2f}" for gain in gains.loc[place]]
        for place in logs.index
    ]
    best = means.drop(ALL).idxmax()
    shares = [f"{x:.2f} with `{name}`" for name, x in means.items()]
    above = [f"`{name}` in {(gains[name] > 0).sum()}" for name in gains.columns]
    return Finding(
        title=f"{len(places)} places do not show which part of `vary` helps: `{best}` "
        f"is best, with {means[best]:.2f} times the error",
        sentences=(
            f"The error in {len(logs)} environments and lights, divided by the error "
            "of an attack that varies nothing, is "
            f"{', '.join(shares[:-1])} and {shares[-1]} (geometric mean).",
            f"The ratio is above 1 for {', '.join(above)} of {len(logs)} rows.",
            "The mean error over all rows differs between the parts by a factor of "
            f"{most:.1f} on `{spreads.idxmax()}`, and by at most {least:.1f} on the "
            "other routes.",
        ),
        head=["environment", "condition", "nothing (m)", *gains.columns],
        rows=rows,
        draw=lambda figure: draw_searches(figure, errors.map(math.exp)),
        pandas="attacks = drives.query(\"case == 'attack'\").copy()\n"
        'print(attacks.groupby(["attack", "environment"]).cross_track_mean_m.mean())',
    )
