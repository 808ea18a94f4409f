"""What smooth and coarse textures cost, and whether they transfer better.

Settled before the first result: places, iterations and drives of `bench.study.steps`,
the default attack, two unseen starts, the path-traced scene. Rows, by what is changed:

- `smoothing 1`: gradients smoothed by one pass;
- `variation 1`, `variation 10`: the penalty on total variation. Its price is the share
  of the mean error that is lost;
- `level 16`, `level 32`: steps in colours of the level with so many vertices an edge,
  of 64. If low resolution is what lets attacks transfer (appendix B.1), these lose less
  of their error from surrogate to deployment.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import rich.table

from bench.study import jobs, rows
from bench.study.places import NATURAL_M, ROUTES, Place
from bench.study.steps import ARC_M, ITERATIONS, KEYS, LATERAL_M
from bench.study.tables import geometric_mean, markdown, mean_m
from mi_nerfattack.scenario.deployment import SURROGATE

DEPLOYMENT = "deployment"

ROWS: Mapping[str, str] = {
    "default": "",
    "smoothing 1": "smoothing = 1",
    "variation 1": "total_variation = 1.0",
    "variation 10": "total_variation = 10.0",
    "level 16": "resolution = 16",
    "level 32": "resolution = 32",
}
#: Random looks are not what is compared.
_REST = "\n[baseline]\ntextures = 1\ndeployment_textures = 1\n\n[deployment]\nspp = 8\n"


def keys() -> list[rows.Row]:
    """Return what tells one row from another, one place after the other."""
    cells = itertools.product(ROUTES, LATERAL_M, ROWS)
    return [{"route": r, "distance": d, "kind": k} for r, d, k in cells]


def attack_row(key: rows.Key) -> rows.Row:
    """Attack in one way."""
    place = Place(key["route"], LATERAL_M[key["distance"]], ARC_M, 0)
    tables = scenario_keys(key["kind"])
    return jobs.run(lambda folder: place.write(2 * NATURAL_M, tables, folder))


def scenario_keys(row: str) -> str:
    """Return the tables of a row's scenario, as TOML."""
    keys = KEYS.replace("horizon = 50", "horizon = 50\nruns = 2")
    return f"{keys}max_iterations = {ITERATIONS}\n{ROWS[row]}\n{_REST}"


def table(found: Sequence[rows.Row]) -> rich.table.Table:
    """Compare what was changed: geometric means of errors, means of textures."""
    cells: dict[str, list[rows.Row]] = {name: [] for name in ROWS}
    for row in found:
        cells[row["kind"]].append(row)
    header = ["changed", "attacks", "surrogate, m", "deployment, m", "transfer"]
    header += ["saturated", "variation", "spectrum: 1, 2, 4, ... voxels"]
    lines = []
    for kind, some in cells.items():
        if not some:
            continue
        here = geometric_mean(mean_m(row, SURROGATE) for row in some)
        there = geometric_mean(mean_m(row, DEPLOYMENT) for row in some)
        saturated = np.mean([row["saturated_share"] for row in some])
        variation = np.mean([row["total_variation"] for row in some])
        spectra = [row["textures"]["hydrant"]["spectrum"] for row in some]
        changed = [spectrum for spectrum in spectra if spectrum]
        shares = np.mean(changed, axis=0).tolist() if changed else []
        spectrum = ", ".join(f"{share:.2f}" for share in shares)
        line = [kind, str(len(some)), here, there, there / here]
        lines.append([*line, float(saturated), float(variation), spectrum])
    return markdown(header, lines)
