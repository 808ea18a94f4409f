"""What an attack reaches wherever an object may stand: 24 drawn places.

Settled before the first result: eight places on each route, drawn by the rule of
training (`bench.study.places`), seeds 1 to 8; the hydrant at its natural height and at
twice; the default attack with the iterations below; drives from two unseen starts to
the end of the route (starts of one attack say little about another). The first draw of
each seed counts, and every row is kept, whatever speaks against it (`flags`; in the
first results, what the checks before an attack found). An attack *succeeds* at a place
if it has a wheel out for a second on average over the drives of the case.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rich.table

from bench.study import jobs, rows
from bench.study.places import NATURAL_M, ROUTES, Place
from bench.study.tables import markdown, mean_m
from mi_nerfattack.evaluation.pairs import DEPARTED_S
from mi_nerfattack.report.plots.charts import BLUE, GREY, ORANGE, chart
from mi_nerfattack.scenario.deployment import SURROGATE

SEEDS = tuple(range(1, 9))
HEIGHTS_M = (NATURAL_M, 2 * NATURAL_M)
#: Training's distances from the lane centre, and all of a route but its ends, metres.
LATERAL_M, ARC_M = (2.0, 5.0), (8.0, 36.0)
ENVIRONMENTS = (SURROGATE, "deployment")
_STYLES: dict[str, dict[str, Any]] = {
    "own": {"color": GREY, "marker": ".", "linestyle": ""},
    "random": {"color": BLUE, "marker": "_", "linestyle": ""},
    "best_random": {"color": BLUE, "marker": "^", "markersize": 4, "linestyle": ""},
    "attack": {"color": ORANGE, "marker": "o", "markersize": 4, "linestyle": ""},
}
KEYS = """
[drive]
runs = 2

[attack]
max_iterations = 24
adjoint = "kept_backgrounds"

[baseline]
textures = 8
deployment_textures = 4

[deployment]
spp = 8
"""


def keys() -> list[rows.Row]:
    """Return what tells one row from another, one place after the other."""
    cells = itertools.product(SEEDS, ROUTES, HEIGHTS_M)
    return [{"route": r, "seed": s, "height_m": h} for s, r, h in cells]


def attack_row(key: rows.Key) -> rows.Row:
    """Attack at one place."""
    place = Place(key["route"], LATERAL_M, ARC_M, key["seed"])
    return jobs.run(lambda folder: place.write(key["height_m"], KEYS, folder))


def table(found: Sequence[rows.Row]) -> rich.table.Table:
    """List all places: mean errors, ratios to random textures, what the checks said."""
    header = ["route", "seed", "height, m", "own, m", "random, m", "attack, m"]
    header += ["to random", "wheel out, s", "deployment: attack, m", "to random"]
    header += ["wheel out, s", "flags"]
    lines = []
    for row in sorted(found, key=lambda r: (r["height_m"], r["route"], r["seed"])):
        line = [row["route"], str(row["seed"]), f"{row['height_m']:.2f}"]
        line += [mean_m(row, SURROGATE, case) for case in ("own", "random")]
        for name in ENVIRONMENTS:
            figures = row["environments"][name]
            line += [mean_m(row, name), mean_m(row, name) / mean_m(row, name, "random")]
            line += [figures["attack"]["wheel_out_s"]]
        lines.append([*line, str(len(row["flags"]))])
    table = markdown(header, lines)
    parts = []
    for height, name in itertools.product(HEIGHTS_M, ENVIRONMENTS):
        out = [
            row["environments"][name]["attack"]["wheel_out_s"]
            for row in found
            if row["height_m"] == height
        ]
        count = sum(seconds >= DEPARTED_S for seconds in out)
        parts.append(f"{height:.2f} m, {name}: {count} of {len(out)}")
    table.caption = f"places where the attack succeeds: {'; '.join(parts)}"
    return table


def draw(path: Path, found: Sequence[rows.Row]) -> None:
    """Draw the distribution of the mean error: each place a point, sorted.

    Args:
        path: PNG file.
        found: all rows.
    """
    with chart(path, 6.0) as figure:
        grid = figure.subplots(len(ENVIRONMENTS), len(HEIGHTS_M), sharey=True)
        for (i, name), (j, height) in itertools.product(
            enumerate(ENVIRONMENTS), enumerate(HEIGHTS_M)
        ):
            some = [row for row in found if row["height_m"] == height]
            some.sort(key=lambda row: mean_m(row, name))
            for case, style in _STYLES.items():
                means = [mean_m(row, name, case) for row in some]
                grid[i, j].plot(range(1, len(some) + 1), means, label=case, **style)
            grid[i, j].set_title(f"{name}, {height:.2f} m tall", loc="left", fontsize=9)
            grid[i, j].set_yscale("log")
            grid[i, j].grid(alpha=0.25)
        for axis in grid[:, 0]:
            axis.set_ylabel("mean distance from the lane centre (m)")
        for axis in grid[-1]:
            axis.set_xlabel("places, by the error of the attack")
        handles = grid[0, 0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=len(_STYLES))
