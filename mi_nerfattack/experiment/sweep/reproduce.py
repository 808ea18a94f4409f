"""Rows of a sweep's table made again, and by how much they differ."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import CHECKPOINT, SCENARIO
from mi_nerfattack.experiment.sweep.cell import Cell, changed, folder_of
from mi_nerfattack.experiment.sweep.table import LABELS, RESULTS, Row, read_table
from mi_nerfattack.io import files

#: What is compared.
FIGURES = ("cross_track_mean_m", "wheel_out_s", "departed", "steps", "frames")
_DRIVE = ("cell", "environment", "case", "run")


@dataclass(frozen=True)
class Replay:
    """What is to be repeated.

    Attributes:
        table: of the sweep, without scenarios.
        indices: rows that were asked for.
        cells: that they are of, as they were done.
    """

    table: list[Row]
    indices: tuple[int, ...]
    cells: tuple[Cell, ...]


def read_replay(
    folder: Path, names: Sequence[str], count: int = 0, seed: int = 0
) -> Replay:
    """Find rows and the cells that made them.

    Args:
        folder: with ``results.parquet``; nothing else of it is read.
        names: rows: their index, from 0, or CELL:ENVIRONMENT:CASE:RUN.
        count: of rows that are drawn besides.
        seed: of that.

    Raises:
        InputError: the table is missing or wrong; there is no such row, it tells of a
            failure, or what it was made of is of other content here.
        SetupError: pyarrow is not installed.
    """
    path = folder / RESULTS
    table = read_table(path)
    indices = [_find(path, table, name) for name in names]
    whole = [i for i, row in enumerate(table) if row["status"] == "complete"]
    if count > len(whole):
        raise InputError(f"{path}: {len(whole)} rows of drives; {count} are asked for")
    drawn = np.random.default_rng(seed).choice(len(whole), count, replace=False)
    indices = dict.fromkeys([*indices, *(whole[i] for i in sorted(drawn))])
    first = {table[i]["cell"]: table[i] for i in indices}
    scenarios = read_table(path, ["cell", "scenario"], first)
    texts = {row["cell"]: row["scenario"] for row in scenarios}
    cells = tuple(_cell(row, texts[name]) for name, row in first.items())
    return Replay(table, tuple(indices), cells)


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
        there, own = folder_of(folder, cell) / CHECKPOINT, folder_of(output, cell)
        here = own / CHECKPOINT
        if not there.exists():
            raise InputError(
                f"{there}: there is none; without --drives-only, the attack is repeated"
            )
        if not here.exists():
            files.make_folder(own)
            files.write_text(own / SCENARIO, cell.text)
            files.write_bytes(here, files.read_bytes(there, files.MAX_TENSOR_BYTES))


def compare_rows(
    replay: Replay, repeated: Iterable[Row], errors: Mapping[str, str]
) -> dict[str, Any]:
    """Say by how much repeated rows differ from the table's.

    Args:
        replay: what was to be repeated.
        repeated: table of the repetition.
        errors: of cells that failed, by cell.

    Returns:
        ``rows``: of each that was asked for its index, labels, `FIGURES` ``stored`` and
        ``repeated``, and their absolute ``difference`` (null where there is no such
        drive this time); ``cells``: of each, how many ``rows`` are compared, how many
        are ``unmatched``, on either side, the ``largest_difference`` of all, what
        ``versions`` differ (there, here), and its ``error``; ``largest_difference`` of
        the rows that were asked for, null where none is there.
    """
    found = {_key(row): row for row in repeated if row["status"] == "complete"}
    told = []
    for index in replay.indices:
        row, again = replay.table[index], found.get(_key(replay.table[index]))
        sides = {"stored": _figures(row), "repeated": again and _figures(again)}
        difference = again and _difference(row, again)
        about = {"row": index} | {name: row[name] for name in _DRIVE}
        told.append(about | sides | {"difference": difference})
    cells = []
    for cell in replay.cells:
        stored = {_key(row): row for row in replay.table if row["cell"] == cell.id}
        own = {key for key in found if key[0] == cell.id}
        both = sorted(stored.keys() & own)
        pairs = [(stored[key], found[key]) for key in both]
        each = {
            "cell": cell.id,
            "rows": len(pairs),
            "unmatched": len(stored.keys() ^ own),
        }
        each["largest_difference"] = _largest(_difference(*pair) for pair in pairs)
        each["versions"] = _versions(*pairs[0]) if pairs else {}
        cells.append(each | {"error": errors.get(cell.id)})
    largest = _largest(row["difference"] for row in told if row["difference"])
    return {"rows": told, "cells": cells, "largest_difference": largest}


def sentences(found: Mapping[str, Any]) -> list[str]:
    """Tell of a repetition in words.

    Args:
        found: of :func:`compare_rows`.
    """
    lines = []
    for row in found["rows"]:
        name = ":".join(str(row[label]) for label in _DRIVE)
        lines.append(f"row {row['row']}, {name}: {_told(row)}")
    for cell in found["cells"]:
        for name, (there, here) in cell["versions"].items():
            lines.append(f"{cell['cell']}: {name} {there} then, {here} here")
        if cell["error"] is not None:
            lines.append(f"failed: {cell['cell']}: {cell['error'].splitlines()[-1]}")
            continue
        told = f"{cell['cell']}: {cell['rows']} rows"
        if largest := cell["largest_difference"]:
            error = largest["cross_track_mean_m"]
            told += f", whose mean errors differ by at most {error:g} m"
        if cell["unmatched"]:
            told += f"; {cell['unmatched']} in one table alone"
        lines.append(told)
    if largest := found["largest_difference"]:
        told = ", ".join(f"{name} {largest[name]:g}" for name in FIGURES)
        lines.append(f"largest difference of these rows: {told}")
    return lines


def _told(row: Mapping[str, Any]) -> str:
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
    """Return the index of a row."""
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


def _cell(row: Row, text: str) -> Cell:
    """Return the cell of a row, as it was done; findings of its checks are told."""
    name, labels = row["cell"], {key: row[key] for key in LABELS[1:]}
    cell = Cell(**labels, text=text, digests=json.loads(row["digests"]), anyway=True)
    if wrong := changed(cell):
        made = json.loads(row["versions"])["mi_nerfattack"]
        raise InputError(
            f"{name}: {', '.join(wrong)}: other content here than where the row was "
            f"made, by version {made}; only the same can be repeated"
        )
    return cell


def _key(row: Row) -> tuple[Any, ...]:
    return tuple(row[name] for name in _DRIVE)


def _figures(row: Row) -> dict[str, Any]:
    return {name: row[name] for name in FIGURES}


def _difference(one: Row, other: Row) -> dict[str, float]:
    return {name: abs(float(one[name]) - float(other[name])) for name in FIGURES}


def _largest(differences: Iterable[dict[str, float]]) -> dict[str, float] | None:
    rows = list(differences)
    return {name: max(row[name] for row in rows) for name in FIGURES} if rows else None


def _versions(one: Row, other: Row) -> dict[str, list[Any]]:
    there, here = json.loads(one["versions"]), json.loads(other["versions"])
    names = sorted(there.keys() | here.keys())
    pairs = {name: [there.get(name), here.get(name)] for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
