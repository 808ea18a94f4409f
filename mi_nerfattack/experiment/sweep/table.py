"""The table of a sweep, with one row per drive, made of the folders of its cells."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from mi_nerfattack.drives.table import (
    INTEGER,
    NUMBER,
    TEXT,
    TRUTH,
    read_csv,
    write_csv,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import cells
from mi_nerfattack.experiment.run_folder import METRICS
from mi_nerfattack.experiment.sweep.cell import Cell, folder_of
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, RANDOM
from mi_nerfattack.scenario.upgrade import upgraded_environment

#: The table, and what its cells were made of.
RESULTS, MADE_OF = "results.csv", "cells.json"
#: Columns and their pandas types; docs/reference/sweep.md says what they mean.
COLUMNS = {
    "cell": TEXT,
    "route": TEXT,
    "objects": TEXT,
    "method": TEXT,
    "budget": INTEGER,
    "seed": INTEGER,
    "environment": TEXT,
    "case": TEXT,
    "run": INTEGER,
    "frames": INTEGER,
    "steps": INTEGER,
    "cross_track_mean_m": NUMBER,
    "wheel_out_s": NUMBER,
    "departed": TRUTH,
    "status": TEXT,
    "error": TEXT,
}
#: Columns that tell cells apart.
LABELS = ("cell", "route", "objects", "method", "budget", "seed")
#: Columns that each drive has.
_OF_DRIVE = [name for name in COLUMNS if name not in (*LABELS, "error")]
_COPIED = ("run", "steps", "cross_track_mean_m", "wheel_out_s")
Row = dict[str, Any]


def complete_rows(cell: Cell, sweep: Path) -> list[Row]:
    """Return a row for each drive of a complete cell.

    Args:
        cell: that is complete.
        sweep: folder of the sweep.

    Raises:
        InputError: a file of the cell's folder is missing or damaged.
    """
    document = files.read_json(folder_of(sweep, cell) / METRICS)
    frames, scenario = _frames(document), document["scenario"]
    return [
        {
            **labels_of(cell),
            "environment": upgraded_environment(case["environment"], scenario),
            "case": case["case"],
            "frames": frames.get(case["case"], 0),
            **{name: drive[name] for name in _COPIED},
            "departed": drive["steps_departed"] > 0,
            "status": "complete",
        }
        for case in cells(document["routes"], "route", "environment", "case")
        for drive in case["per_run"]
    ]


def failed_row(cell: Cell, error: str) -> Row:
    """Return the one row of a cell that failed."""
    lines = "\n".join(error.splitlines())  # a lone \\r would end a row of the file
    return {**labels_of(cell), "status": "failed", "error": lines}


def made_of(cell: Cell, versions: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return what a cell is made of: digests of its files, versions, scenario.

    Args:
        cell: of the sweep.
        versions: of packages and variant; None of a cell that failed.
    """
    return {"digests": cell.digests, "versions": versions, "scenario": cell.text}


def make_table(rows: Iterable[Row]) -> pd.DataFrame:
    """Return rows as a table; values that are missing are NA."""
    return pd.DataFrame(list(rows), columns=list(COLUMNS)).astype(COLUMNS)


def write_table(folder: Path, rows: Iterable[Row], cells: Mapping[str, Any]) -> None:
    """Write the table of a sweep, and `made_of` of its cells, each file at once."""
    files.write_json(folder / MADE_OF, cells)
    write_csv(folder / RESULTS, make_table(rows))


def read_table(path: Path) -> pd.DataFrame:
    """Read a table, with `cross_track_total`: mean error times steps.

    Environments of a table of an older version get their names of today.

    Raises:
        InputError: there is none, or it is damaged, too large, or not a sweep's table.
    """
    table = read_csv(path, COLUMNS)
    drives = table[table["status"] == "complete"]
    is_known = table["status"].isin(["complete", "failed"])
    if not is_known.all() or drives[_OF_DRIVE].isna().any(axis=None):
        raise InputError(
            f"{path}: damaged: a drive has no figures; give the sweep's command again, "
            "which makes the table again"
        )
    old = table.loc[table["environment"] == "deployment", "cell"]
    made = read_made(path.parent) if len(old) else {}
    for cell, rows in old.groupby(old):
        scenario = parse_toml(cell, made_of_row(made, path.parent, cell)["scenario"])
        name = upgraded_environment("deployment", scenario)
        table.loc[rows.index, "environment"] = name
    return with_total(table)


def with_total(table: pd.DataFrame) -> pd.DataFrame:
    """Add `cross_track_total`, metre-steps."""
    steps = table["steps"].astype(NUMBER)
    return table.assign(cross_track_total=table["cross_track_mean_m"] * steps)


def read_made(folder: Path) -> dict[str, Any]:
    """Read what the cells of a sweep were made of, see :func:`made_of`.

    Raises:
        InputError: the file is missing or damaged.
    """
    return files.read_json(folder / MADE_OF)


def made_of_row(made: Mapping[str, Any], folder: Path, cell: str) -> dict[str, Any]:
    """Return what the cell of a row was made of.

    Args:
        made: of :func:`read_made`.
        folder: of the table.
        cell: of the row.

    Raises:
        InputError: `made` has no such cell.
    """
    if cell not in made:
        raise InputError(
            f"{folder / MADE_OF}: has no {cell}, which {RESULTS} has; copy both files "
            "from the folder of one sweep"
        )
    return made[cell]


def labels_of(cell: Cell) -> Row:
    """Return what all rows of a cell have in common."""
    names = ("route", "objects", "method", "budget", "seed")
    return {"cell": cell.id} | {name: getattr(cell, name) for name in names}


def _frames(document: Any) -> dict[str, int]:
    """Return the frames that finding what each case shows has cost.

    Args:
        document: content of ``metrics.json``.
    """
    frames = document["curve"]["frames"]  # every method's first is one judgement
    return {
        RANDOM: frames[0],
        BEST_RANDOM: frames[0] * document["baseline"]["textures"],
        ATTACK: frames[-1],
    }
