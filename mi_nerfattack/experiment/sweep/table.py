"""The table of a sweep: one Parquet file, a row a drive, made of the cells' folders."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mi_nerfattack.experiment.sweep.cell import PROVENANCE, Cell, folder_of
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, RANDOM
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.world import judged_frames
from mi_nerfattack.system.extras import load_extra

FORMAT = "mi_nerfattack sweep 1"
RESULTS = "results.parquet"
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
    "cross_track_mean_m": "float64",
    "wheel_out_s": "float64",
    "departed": "bool_",
    "status": "string",
    "error": "string",
    "digests": "string",
    "versions": "string",
}
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
    document = files.read_json(folder / "metrics.json")
    about = files.read_json(folder / PROVENANCE)
    frames = _frames(cell.scenario, document)
    labels = _labels(cell) | {"versions": json.dumps(about["versions"])}
    return [
        {
            **labels,
            "environment": environment,
            "case": case,
            "run": drive["run"],
            "frames": frames.get(case, 0),
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
    return {**_labels(cell), "status": "failed", "error": error}


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
    types = [(name, getattr(pa, kind)()) for name, kind in SCHEMA.items()]
    schema = pa.schema(types, metadata={"format": FORMAT})
    buffer = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist(list(rows), schema=schema), buffer)
    files.write_bytes(path, buffer.getvalue())


def _labels(cell: Cell) -> Row:
    return {
        "cell": cell.id,
        "route": cell.route,
        "objects": cell.objects,
        "method": cell.method,
        "budget": cell.budget,
        "seed": cell.seed,
        "digests": json.dumps(cell.digests),
    }


def _frames(scenario: Scenario, document: Any) -> dict[str, int]:
    """Return the frames that finding what each case shows has cost.

    Args:
        scenario: of the cell.
        document: content of ``metrics.json``.
    """
    judged = judged_frames(scenario)
    return {
        RANDOM: judged,
        BEST_RANDOM: judged * document["baseline"]["textures"],
        ATTACK: document["curve"]["frames"][-1],
    }
