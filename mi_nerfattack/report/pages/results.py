"""The page of results: one HTML file that needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.colors import to_hex

from mi_nerfattack.io import files
from mi_nerfattack.report import table
from mi_nerfattack.report.columns import Cell, Column, Table
from mi_nerfattack.report.pages.elements import (
    PageContents,
    RunPart,
    TransferPart,
    render,
)
from mi_nerfattack.report.plots.transfer import COLOURS, LIGHT, Line, matrix_lines

_COST_LABELS: Mapping[str, str] = {
    "wall_s": "wall time (s)",
    "peak_memory_mb": "peak memory (MB)",
    "renders": "frames rendered",
    "checkpoint_s": "of the wall time, in checkpoints (s)",
    "processes": "processes, one and one a resumption",
    "forward_s": "of the wall time, in the attack's drives (s)",
    "backward_s": "of the wall time, in their backward passes (s)",
}


def write_results_page(path: str | Path, title: str, contents: PageContents) -> None:
    """Write a self-contained HTML page, atomically.

    Args:
        path: HTML file.
        title: of the page.
        contents: what it shows.
    """
    shown = contents.shown
    cost: list[dict[str, Any]] = [
        {
            _COST_LABELS.get(key, key): value
            for key, value in run.document["cost"].items()
        }
        for run in shown
    ]
    text = render(
        "results.html.j2",
        title=title,
        contents=contents,
        shown=shown,
        tables=table,
        matrix=_matrix,
        commands=_commands(shown),
        cost=_beside(shown, cost, "What the runs cost, over all their processes."),
        made_with=_beside(
            shown,
            [run.made_with for run in shown],
            "Versions that the runs were made with.",
        ),
        digests=_beside(
            shown,
            [run.digests for run in shown],
            "Of the files that the scenarios name.",
        ),
    )
    files.write_text(path, text)


def _matrix(part: TransferPart) -> Table:
    """Return a transfer's matrix: a line for each environment and case or attack."""
    document = part.document
    names = dict.fromkeys(column["environment"] for column in document["columns"])
    lines = [(name, line) for name in names for line in matrix_lines(document, name)]
    values = [value for _, line in lines for value, _ in line.cells.values()]
    most, colours = max([*values, 1e-9]), matplotlib.colormaps[COLOURS]

    def cell(line: Line, condition: str) -> Cell:
        if condition not in line.cells:
            return Cell("")
        value, label = line.cells[condition]
        text, _, out = label.partition("\n")
        share = value / most
        colour = "#000" if share > LIGHT else "#fff"
        style = f"background: {to_hex(colours(share))}; color: {colour}"
        return Cell(text, out, style=style)

    caption = (
        f"{part.label}: {len(document['attacks'])} attacks, unchanged, from "
        f"{document['starts']} unseen starts each. Mean distance from the lane centre "
        "(m), the darker the nearer; below that of attacks, how many have a wheel out "
        f"for {document['success_s']:g} s. Light has no effect on a field: nothing was "
        "driven there."
    )
    labels = [
        Column("environment", lambda row: row[0]),
        Column("case", lambda row: row[1].label.strip()),
    ]
    figures = [
        Column(name.replace(",", ", "), lambda row, name=name: cell(row[1], name))
        for name in document["conditions"]
    ]
    return Table("", labels, figures, records=lines, caption=caption)


def _commands(runs: Sequence[RunPart]) -> Table:
    figures = [
        Column("seed", lambda run: run.document["seed"]),
        Column("command", lambda run: Cell(run.repeat, code=True)),
    ]
    caption = "What makes each run again; RUN is a new folder."
    labels = [Column("run", lambda run: run.label)]
    return Table("", labels, figures, records=runs, caption=caption)


def _beside(
    runs: Sequence[RunPart], columns: Sequence[Mapping[str, Any]], caption: str
) -> Table:
    """Lay facts of runs beside each other: a row for each fact, a column for a run."""

    def fact(index: int) -> Column:
        header = runs[index].label if len(runs) > 1 else ""
        return Column(header, lambda name: columns[index].get(name), digits=1)

    names = list(dict.fromkeys(name for column in columns for name in column))
    figures = [fact(index) for index in range(len(runs))]
    return Table("", [Column("", str)], figures, records=names, caption=caption)
