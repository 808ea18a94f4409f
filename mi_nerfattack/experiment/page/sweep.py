"""A sweep as a page shows it: its summary, its attacks, and some of its cells."""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from mi_nerfattack.drives.table import records
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.page.run import draw_above, read_run
from mi_nerfattack.experiment.sweep.cell import CELLS, COMPLETE
from mi_nerfattack.experiment.sweep.summary import read_attacks, summarise
from mi_nerfattack.experiment.sweep.table import LABELS, RESULTS, read_table
from mi_nerfattack.report.pages.elements import SHOWN_CASES, RunPart, SweepPart
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.deployment import SURROGATE


def read_sweep(
    folder: Path, label: str, scratch: Path, on_run: Callable[[str], None]
) -> SweepPart:
    """Read a sweep's table, and of each route and method the cell of middle damage.

    Args:
        folder: of the sweep, or a copy of its table alone.
        label: name of the sweep on the page, different from other names.
        scratch: folder for plots that are made for the page.
        on_run: called with the label of each cell before its objects are rendered.

    Raises:
        InputError: the table or the folder of a cell is damaged.
    """
    table = read_table(folder / RESULTS)
    cells, known = folder / CELLS, table["cell"].unique()
    attack_rows = read_attacks(folder, table)
    sections = {one["cell"]: one["section"] for one in attack_rows if "section" in one}
    notes = []
    begun = [path for path in cells.glob("*/") if not (path / COMPLETE).exists()]
    if begun:
        notes.append(
            f"{label} is not finished: {len(begun)} cells were begun and are not "
            "complete; the sweep's command goes on with them."
        )
    if len(sections) < len(known):
        notes.append(
            f"{len(known) - len(sections)} of {len(known)} cells have no folder in "
            f"{cells}, or failed: there is nothing of them but their rows."
        )
    attacks = _attacks(folder, table, sections)
    return SweepPart(
        label=label,
        document=summarise(table, attack_rows),
        attacks=attacks,
        shown=_shown(
            cells, [row for row in attacks if row["cell"] in sections], on_run
        ),
        pictures=_pictures(
            cells,
            table,
            sections,
            scratch=Path(tempfile.mkdtemp(dir=scratch)),
            notes=notes,
        ),
        notes=notes,
    )


def _attacks(
    folder: Path, table: pd.DataFrame, sections: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return a row for each cell and environment, in the table's order.

    Returns:
        labels, `environment`, `error` (None unless the cell failed), `cases` (mean
        error over its drives by case, metres), `wheel_out_s` past the attack,
        `section` (`attack` of its scenario, None without its folder), and `repeat`, a
        command.
    """
    rows = []
    for _, own in table.groupby(["cell", "environment"], sort=False, dropna=False):
        [row] = records(own[[*LABELS, "environment", "error"]].head(1))
        cases = {case: own[own["case"] == case] for case in SHOWN_CASES}
        means = {
            case: float(drives["cross_track_mean_m"].mean())
            for case, drives in cases.items()
            if len(drives)
        }
        attack = cases[ATTACK]["wheel_out_s"]
        out_s = float(attack.mean()) if len(attack) else None
        name = f"{row['cell']}:{row['environment']}:{ATTACK}:0"
        words = ["mi-nerfattack", "reproduce", str(folder), name]
        if row["error"] is not None:
            words = []
        row |= {"cases": means, "wheel_out_s": out_s}
        row["section"] = sections.get(row["cell"])
        rows.append(row | {"repeat": shlex.join(words)})
    return rows


def _shown(
    cells: Path, attacks: Sequence[Mapping[str, Any]], on_run: Callable[[str], None]
) -> list[RunPart]:
    """Read the cell of middle damage in the surrogate of each route and method."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in attacks:
        if row["environment"] == SURROGATE and ATTACK in row["cases"]:
            key = row["route"], row["method"], row["budget"]
            groups.setdefault(key, []).append(row)
    runs = []
    for key, own in groups.items():
        ordered = sorted(own, key=lambda row: row["cases"][ATTACK])
        middle = ordered[len(ordered) // 2]
        label = " ".join(str(word) for word in key if word is not None)
        label += f", {middle['objects']}, seed {middle['seed']}"
        label += f" (the middle one of {len(own)})"
        on_run(label)
        runs.append(read_run(cells / middle["cell"], label, middle["repeat"]))
    return runs


def _pictures(
    cells: Path,
    table: pd.DataFrame,
    present: Collection[str],
    scratch: Path,
    notes: list[str],
) -> dict[str, Path]:
    """Plot the drives of all cells of each route and method from above."""
    pictures = {}
    rows = table[table["cell"].isin(list(present))]
    for (route, method), own in rows.groupby(["route", "method"], sort=False):
        name, folders = f"{route}, {method}", [cells / c for c in own["cell"].unique()]
        path = scratch / f"above_{len(pictures)}.png"
        try:
            draw_above(path, folders)
        except InputError as err:  # scenarios name files of the machine that made them
            notes.append(f"No drives from above of {name}: {err}")
        else:
            pictures[f"First drives of all attacks: {name}, n = {len(folders)}"] = path
    return pictures
