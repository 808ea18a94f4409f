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
