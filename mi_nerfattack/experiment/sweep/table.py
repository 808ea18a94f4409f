"""The table of a sweep: one Parquet file, a row a drive, made of the cells' folders."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import METRICS
from mi_nerfattack.experiment.sweep.cell import PROVENANCE, Cell, folder_of
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, RANDOM
from mi_nerfattack.system.extras import load_extra

FORMAT = "mi_nerfattack sweep 1"
RESULTS = "results.parquet"
MAX_TABLE_BYTES = 1 << 30
MAX_ROWS = 1 << 24
#: Columns and their Arrow types; docs/sweep.md says what they mean.
SCHEMA = {
    "cell": "string",
    "route": "string",
    "objects": "string",
    "method": "string",
    "budget": "int64",
    "seed": "int64",
    "environment": "string",
    "case": "string",
    "run": "int64",
    "frames": "int64",
    "steps": "int64",
    "cross_track_mean_m": "float64",
    "wheel_out_s": "float64",
    "departed": "bool_",
    "status": "string",
    "error": "string",
    "digests": "string",
    "versions": "string",
    "scenario": "category",
}
#: Columns that tell cells apart.
LABELS = ("cell", "route", "objects", "method", "budget", "seed")
Row = dict[str, Any]


def require_parquet() -> None:
    """Raise SetupError where tables cannot be written."""
    load_extra("pyarrow", "sweep", "a sweep's table")


def complete_rows(cell: Cell, sweep: Path) -> list[Row]:
    """Return a row for each drive of a complete cell.

    Args:
        cell: that is complete.
        sweep: folder of the sweep.

    Raises:
        InputError: a file of the cell's folder is missing or damaged.
    """
    folder = folder_of(sweep, cell)
    document = files.read_json(folder / METRICS)
    about = files.read_json(folder / PROVENANCE)
    frames = _frames(document)
    labels = labels_of(cell) | {"versions": json.dumps(about["versions"])}
    return [
        {
            **labels,
            "environment": environment,
            "case": case,
            "run": drive["run"],
            "frames": frames.get(case, 0),
            "steps": drive["steps"],
            "cross_track_mean_m": drive["cross_track_mean_m"],
            "wheel_out_s": drive["wheel_out_s"],
            "departed": drive["steps_departed"] > 0,
            "status": "complete",
        }
        for cases in document["routes"].values()
        for environment, figures in cases.items()
        for case, found in figures.items()
        for drive in found["per_run"]
    ]


def failed_row(cell: Cell, error: str) -> Row:
    """Return the one row of a cell that failed."""
    return {**labels_of(cell), "status": "failed", "error": error}


def write_table(path: Path, rows: Iterable[Row]) -> None:
    """Write the table, whole or not at all.

    Args:
        path: of the file.
        rows: values that are missing are null.

    Raises:
        InputError: it cannot be written; the file that was there is intact.
        SetupError: pyarrow is not installed.
    """
    pa = load_extra("pyarrow", "sweep", "a sweep's table")
    parquet = load_extra("pyarrow.parquet", "sweep", "a sweep's table")
    buffer = io.BytesIO()
    table = pa.Table.from_pylist(list(rows), schema=_schema(pa))
    parquet.write_table(table, buffer)
    files.write_bytes(path, buffer.getvalue())


def read_table(
    path: Path, columns: Sequence[str] | None = None, cells: Iterable[str] | None = None
) -> list[Row]:
    """Read a table, row by row.

    Args:
        path: of the file.
        columns: names; by default all but the scenarios, which are long.
        cells: whose rows are wanted; by default all.

    Raises:
        InputError: there is none, or it is damaged, too large, or not a sweep's table.
        SetupError: pyarrow is not installed.
    """
    pa = load_extra("pyarrow", "sweep", "a sweep's table")
    load_extra("pyarrow.compute", "sweep", "a sweep's table")
    parquet = load_extra("pyarrow.parquet", "sweep", "a sweep's table")
    raw = files.read_bytes(path, MAX_TABLE_BYTES)
    try:
        with parquet.ParquetFile(io.BytesIO(raw)) as file:
            _check(path, file.schema_arrow, file.metadata.num_rows, _schema(pa))
            names = [name for name in SCHEMA if name != "scenario"]
            table = file.read(columns=columns or names)
            if cells is not None:
                wanted = pa.compute.field("cell").isin(list(cells))
                table = table.filter(wanted)
            return table.to_pylist()
    except (pa.ArrowException, OSError, ValueError) as err:
        if isinstance(err, InputError):
            raise
        raise InputError(
            f"{path}: no Parquet file, or a damaged one ({err}); give the sweep's "
            "command again, which makes it anew"
        ) from err


def _schema(pa: Any) -> Any:
    """Return the table's Arrow schema; equal scenarios are kept once."""
    category = pa.dictionary(pa.int32(), pa.string())
    types = [
        (name, category if kind == "category" else getattr(pa, kind)())
        for name, kind in SCHEMA.items()
    ]
    return pa.schema(types, metadata={"format": FORMAT})


def _check(path: Path, found: Any, rows: int, wanted: Any) -> None:
    """Refuse other tables, and larger ones than are read."""
    told = (found.metadata or {}).get(b"format", b"").decode(errors="replace")
    if told != FORMAT:
        raise InputError(
            f"{path}: not a sweep's table (format {told!r}, not {FORMAT!r})"
        )
    here, there = (set(zip(s.names, s.types, strict=True)) for s in (found, wanted))
    if wrong := sorted({name for name, _ in here ^ there}):
        raise InputError(
            f"{path}: columns {', '.join(wrong)} are missing or others than ours; "
            "give the sweep's command again, which makes the table anew"
        )
    if rows > MAX_ROWS:
        raise InputError(f"{path}: {rows} rows; at most {MAX_ROWS} are read")


def labels_of(cell: Cell) -> Row:
    """Return what all rows of a cell have in common."""
    return {
        "cell": cell.id,
        "route": cell.route,
        "objects": cell.objects,
        "method": cell.method,
        "budget": cell.budget,
        "seed": cell.seed,
        "digests": json.dumps(cell.digests),
        "scenario": cell.text,
    }


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
