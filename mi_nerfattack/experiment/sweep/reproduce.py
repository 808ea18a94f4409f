"""Rows of a sweep's table made again, and by how much they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.drives.table import records
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.claim import CHECKPOINT, EFFORT, SCENARIO
from mi_nerfattack.experiment.sweep.cell import (
    Cell,
    absolute_text,
    changed,
    folder_of,
)
from mi_nerfattack.experiment.sweep.table import (
    LABELS,
    RESULTS,
    Row,
    made_of_row,
    read_made,
    read_table,
)
from mi_nerfattack.io import files
from mi_nerfattack.scenario.upgrade import upgraded_text

#: What is compared.
FIGURES = ["cross_track_mean_m", "wheel_out_s", "departed", "steps", "frames"]
_DRIVE = ["cell", "environment", "case", "run"]


@dataclass(frozen=True)
class Replay:
    """What is to be repeated.

    Attributes:
        table: of the sweep.
        indices: rows that were asked for.
        cells: that they are of, as they were done.
        versions: of packages and variant, by cell of the table.
    """

    table: pd.DataFrame
    indices: tuple[int, ...]
    cells: tuple[Cell, ...]
    versions: Mapping[str, dict[str, str]]


def read_replay(
    folder: Path, names: Sequence[str], count: int = 0, seed: int = 0
) -> Replay:
    """Find rows and the cells that made them.

    Args:
        folder: with ``results.csv`` and ``cells.json``; nothing else of it is read.
            Relative paths of a cell begin in its parent, where the grid of a committed
            table is.
        names: rows: their index, from 0, or CELL:ENVIRONMENT:CASE:RUN.
        count: number of rows to draw at random, too.
        seed: of the draw.

    Raises:
        InputError: the table is missing or wrong, or there is no such row. The row is
            of a cell that failed, or the files that its cell was made of have other
            content here.
    """
    path = folder / RESULTS
    whole_table = read_table(path)
    table = records(whole_table)
    indices = [_find(path, table, name) for name in names]
    complete = [i for i, row in enumerate(table) if row["status"] == "complete"]
    if count > len(complete):
        raise InputError(
            f"{path}: {len(complete)} rows of drives; {count} are asked for"
        )
    drawn = np.random.default_rng(seed).choice(len(complete), count, replace=False)
    indices = dict.fromkeys([*indices, *(complete[i] for i in sorted(drawn))])
    first = {table[i]["cell"]: table[i] for i in indices}
    made = read_made(folder)
    cells = tuple(
        _cell(row, made_of_row(made, folder, name), folder)
        for name, row in first.items()
    )
    versions = {name: provenance["versions"] for name, provenance in made.items()}
    return Replay(whole_table, tuple(indices), cells, versions)


def take_checkpoints(replay: Replay, folder: Path, output: Path) -> None:
    """Let cells go on from the attacks that they found, so that they only drive.

    Args:
        replay: what is to be repeated.
        folder: of the sweep, whose cells are there.
        output: where they are done again.

    Raises:
        InputError: a cell's checkpoint is missing, or cannot be copied.
    """
    for cell in replay.cells:
        source, own = folder_of(folder, cell), folder_of(output, cell)
        original, target = source / CHECKPOINT, own / CHECKPOINT
        if not original.exists():
            raise InputError(
                f"{original}: there is none; without --drives-only, the attack is "
                "repeated"
            )
        if not target.exists():
            files.make_folder(own)
            files.write_text(own / SCENARIO, cell.text)
            for name in (EFFORT, CHECKPOINT):  # the last tells that all are there
                raw = files.read_bytes(source / name, files.MAX_TENSOR_BYTES)
                files.write_bytes(own / name, raw)


def compare_rows(
    replay: Replay,
    repeated: pd.DataFrame,
    made: Mapping[str, Any],
    errors: Mapping[str, str],
) -> dict[str, Any]:
    """Say by how much repeated rows differ from the table's.

    Args:
        replay: rows and cells to repeat.
        repeated: table of the repetition.
        made: programs and files that made the cells of `repeated`.
        errors: of cells that failed, by cell.

    Returns:
        ``rows``: one per row of the replay, with index, labels, the `FIGURES`
        ``stored`` and ``repeated``, and their absolute ``difference``. Figures are null
        where there is no such drive this time. ``cells``: one per cell. ``rows`` counts
        the compared rows, and ``unmatched`` the rows of one table alone. A cell also
        has the ``largest_difference`` of its rows, the ``versions`` that differ (there,
        here), and its ``error``. ``largest_difference``: of the ``rows``, null if no
        row was repeated.
    """
    stored, again = (
        table[table["status"] == "complete"].set_index(_DRIVE)[FIGURES]
        for table in (replay.table, repeated)
    )
    difference = (stored.astype(float) - again.astype(float)).abs()
    rows, asked = [], replay.table.iloc[list(replay.indices)]
    for index, labels in zip(replay.indices, records(asked[_DRIVE]), strict=True):
        row, key = {"row": index} | labels, tuple(labels.values())
        sides = {"stored": stored, "repeated": again, "difference": difference.dropna()}
        for name, side in sides.items():
            row[name] = records(side.loc[[key]])[0] if key in side.index else None
        rows.append(row)
    cells = []
    for cell in replay.cells:
        own = difference[difference.index.get_level_values("cell") == cell.id]
        old, new = replay.versions[cell.id], made.get(cell.id, {}).get("versions")
        both = own.dropna()
        cells.append(
            {
                "cell": cell.id,
                "rows": len(both),
                "unmatched": len(own) - len(both),
                "largest_difference": _largest(both),
                "versions": _versions(old, new) if len(both) and new else {},
                "error": errors.get(cell.id),
            }
        )
    known = [row["difference"] for row in rows if row["difference"]]
    largest = _largest(pd.DataFrame(known))
    return {"rows": rows, "cells": cells, "largest_difference": largest}


def sentences(comparison: Mapping[str, Any]) -> list[str]:
    """Tell of a repetition in words.

    Args:
        comparison: of :func:`compare_rows`.
    """
    lines = []
    for row in comparison["rows"]:
        name = ":".join(str(row[label]) for label in _DRIVE)
        lines.append(f"row {row['row']}, {name}: {_describe_row(row)}")
    for cell in comparison["cells"]:
        for name, (old, new) in cell["versions"].items():
            lines.append(f"{cell['cell']}: {name} {old} then, {new} here")
        if cell["error"] is not None:
            lines.append(f"failed: {cell['cell']}: {cell['error'].splitlines()[-1]}")
            continue
        sentence = f"{cell['cell']}: {cell['rows']} rows"
        if largest := cell["largest_difference"]:
            error = largest["cross_track_mean_m"]
            sentence += f", whose mean errors differ by at most {error:g} m"
        if cell["unmatched"]:
            sentence += f"; {cell['unmatched']} in one table alone"
        lines.append(sentence)
    if largest := comparison["largest_difference"]:
        differences = ", ".join(f"{name} {largest[name]:g}" for name in FIGURES)
        lines.append(f"largest difference of these rows: {differences}")
    return lines


def _describe_row(row: Mapping[str, Any]) -> str:
    stored, again = row["stored"], row["repeated"]
    if again is None:
        return "there is no such drive this time"
    changes = [
        f"{name} {stored[name]} then, {again[name]} here ({row['difference'][name]:g})"
        for name in FIGURES
        if row["difference"][name]
    ]
    error = f"mean error {stored['cross_track_mean_m']} m"
    return ", ".join(changes) if changes else f"{error}, all equal"


def _find(path: Path, table: Sequence[Row], name: str) -> int:
    if name.isdecimal():
        index = int(name)
        if index >= len(table):
            raise InputError(f"{path}: row {name}; there are 0 to {len(table) - 1}")
    else:
        keys = [":".join(str(row[label]) for label in _DRIVE) for row in table]
        if name not in keys:
            raise InputError(
                f"{path}: no row {name}; give an index, or "
                f"CELL:ENVIRONMENT:CASE:RUN, such as {keys[0] if keys else 'none'}"
            )
        index = keys.index(name)
    if table[index]["status"] != "complete":
        cell, error = table[index]["cell"], table[index]["error"]
        raise InputError(
            f"{path}: row {name}: {cell} failed ({error}); give the sweep's command "
            "again, which tries it again"
        )
    return index


def _cell(row: Row, made: Mapping[str, Any], folder: Path) -> Cell:
    """Return the cell of a row, as it was done; findings of its checks are told."""
    name, labels = row["cell"], {key: row[key] for key in LABELS[1:]}
    digests, text = dict(made["digests"]), made["scenario"]
    today = upgraded_text(name, text)
    absolute = absolute_text(name, today, folder.resolve().parent)
    cell = Cell(**labels, text=absolute, digests=digests, anyway=True, name=name)
    if today != text:  # of the first form, whose digest is made of other keys
        digests["scenario"] = cell.scenario.digest()
    if wrong := changed(cell):
        raise InputError(
            f"{name}: {', '.join(wrong)}: other content here than where the row was "
            f"made, by version {made['versions']['mi_nerfattack']}; only the same can "
            "be repeated"
        )
    return cell


def _largest(differences: pd.DataFrame) -> dict[str, float] | None:
    if differences.empty:
        return None
    return {name: float(differences[name].max()) for name in FIGURES}


def _versions(old: Mapping[str, str], new: Mapping[str, str]) -> dict[str, list[Any]]:
    names = sorted(old.keys() | new.keys())
    pairs = {name: [old.get(name), new.get(name)] for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
