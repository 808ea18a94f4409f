"""How much each disturbance of the optimisation helps an attack to transfer.

Settled before the first result: one place on each route (the near ones of
`bench.study.steps`), two seeds, equal numbers of rendered frames (48 drives: an attack
from four poses has a quarter of the iterations), two unseen starts. Deployments: the
path-traced scene as it is, half as bright and twice as bright (objects built in, since
pasted ones keep their exposure), blurred, noisy. *Transfer* is the mean error there
over that in the surrogate; the error itself stands beside it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import rich.table

from bench.study import jobs, rows
from bench.study.places import NATURAL_M, ROUTES, Place
from bench.study.steps import ARC_M, LATERAL_M
from bench.study.tables import geometric_mean, markdown, mean_m
from mi_nerfattack.scenario.deployment import SURROGATE

DRIVES, SEEDS = 48, (0, 1)
POSES = 4
PARTS: Mapping[str, str] = {
    "jitter": "jitter = true",
    "exposure": "exposure_ev_sd = 0.5",
    "blur": "blur_px_sd = 0.7",
    "noise": "noise_sd = 0.03",
}
#: Parts by row; all but the first optimise from `POSES` poses.
ROWS: Mapping[str, tuple[str, ...]] = {
    "one pose": (),
    "poses": (),
    **{f"poses, {name}": (name,) for name in PARTS},
    "all": tuple(PARTS),
}
DEPLOYMENTS: Mapping[str, str] = {
    "clear": "",
    "dark": 'exposure_ev = -1.0\nobjects = "built-in"',
    "bright": 'exposure_ev = 1.0\nobjects = "built-in"',
    "blurred": "blur_px = 1.0",
    "noisy": "noise_sd = 0.03",
}


def keys() -> list[rows.Row]:
    """Return what tells one row from another, one place after the other."""
    cells = itertools.product(SEEDS, ROUTES, ROWS)
    return [{"seed": s, "route": r, "parts": p} for s, r, p in cells]


def attack_row(key: rows.Key) -> rows.Row:
    """Attack with some parts."""
    place = Place(key["route"], LATERAL_M["near"], ARC_M, 0)
    tables = scenario_keys(key["parts"])
    seed = key["seed"]
    return jobs.run(lambda f: place.write(2 * NATURAL_M, tables, f, seed))


def scenario_keys(row: str) -> str:
    """Return the tables of a row's scenario, as TOML."""
    poses = 1 if row == "one pose" else POSES
    attack = [
        f"poses = {poses}",
        f"max_iterations = {DRIVES // poses}",
        'adjoint = "kept_backgrounds"',
        *(PARTS[name] for name in ROWS[row]),
    ]
    deployments = [
        f'[[deployment]]\nname = "{name}"\nspp = 8\n{more}\n'
        for name, more in DEPLOYMENTS.items()
    ]
    tables = [
        "[drive]",
        "horizon = 50",
        "runs = 2",
        "",
        "[attack]",
        *attack,
        "",
        "[baseline]",
    ]
    tables += ["textures = 1", "deployment_textures = 1", ""]
    return "\n".join(["", *tables, *deployments])


def table(found: Sequence[rows.Row]) -> rich.table.Table:
    """Compare parts: geometric means over places and seeds, error and transfer."""
    cells: dict[str, list[rows.Row]] = {name: [] for name in ROWS}
    for row in found:
        cells[row["parts"]].append(row)
    lines = []
    for parts, some in cells.items():
        if not some:
            continue
        here = [mean_m(row, SURROGATE) for row in some]
        line = [parts, str(len(some)), geometric_mean(here)]
        for name in DEPLOYMENTS:
            there = geometric_mean(mean_m(row, name) for row in some)
            line += [f"{there:.3f} ({there / geometric_mean(here):.2f})"]
        lines.append(line)
    header = [
        "parts",
        "attacks",
        "surrogate, m",
        *(f"{n}, m (transfer)" for n in DEPLOYMENTS),
    ]
    return markdown(header, lines)
