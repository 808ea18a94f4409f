"""Complete cells of sweeps that were done elsewhere, by their tables alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_nerfattack.experiment.sweep.summary import told_attacks
from mi_nerfattack.experiment.sweep.table import RESULTS, Row, read_table


@dataclass(frozen=True)
class Taken:
    """What stands for cells that are not done again.

    Attributes:
        rows: of the table, of each complete cell.
        attacks: of the summary, by cell.
    """

    rows: Mapping[str, Sequence[Row]] = field(default_factory=dict)
    attacks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def read_taken(folders: Iterable[Path]) -> Taken:
    """Read the complete cells of other sweeps.

    Args:
        folders: with ``results.parquet`` and, for curves and flags, ``summary.json``;
            of a cell that several have, the first one's counts.

    Raises:
        InputError: a table is missing, or a file is damaged.
        SetupError: pyarrow is not installed.
    """
    rows: dict[str, list[Row]] = {}
    attacks: dict[str, Mapping[str, Any]] = {}
    for folder in folders:
        own: dict[str, list[Row]] = {}
        for row in read_table(folder / RESULTS):
            if row["status"] == "complete":
                own.setdefault(row["cell"], []).append(row)
        rows, attacks = own | rows, told_attacks(folder) | attacks
    return Taken(rows, attacks)
