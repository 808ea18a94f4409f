"""The page of results: one HTML file that needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.colors import to_hex

from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import render
from mi_nerfattack.report.pages.parts import Parts, RunPart
from mi_nerfattack.report.plots.transfer import COLOURS, LIGHT, matrix_lines
from mi_nerfattack.rollout.drive import ATTACK, RANDOM

_COST_LABELS = {
    "wall_s": "wall time (s)",
    "peak_memory_mb": "peak memory (MB)",
    "renders": "frames rendered",
    "checkpoint_s": "of the wall time, in checkpoints (s)",
    "processes": "processes, one and one a resumption",
    "forward_s": "of the wall time, in the attack's drives (s)",
    "backward_s": "of the wall time, in the passes back through them (s)",
}


def write_results_page(path: str | Path, title: str, parts: Parts) -> None:
    """Write a self-contained HTML page, atomically.

    Args:
        path: HTML file.
        title: of the page.
        parts: what it shows.
    """
    shown = parts.shown
    text = render(
        "results.html.j2",
        title=title,
        parts=parts,
        shown=shown,
        headline=[row for run in parts.runs for row in _headline(run)],
        matrices=[_matrix(part.document) for part in parts.transfers],
        cost=_beside([run.document["cost"] for run in shown], _COST_LABELS),
        made_with=_beside([run.made_with for run in shown]),
        digests=_beside([run.digests for run in shown]),
    )
    files.write_text(path, text)


def _headline(run: RunPart) -> list[dict[str, Any]]:
    """Return a row for each route and environment."""
    return [
        {
            "run": run.label,
            "route": route,
            "environment": environment,
            "cases": cases,
            "ratio": _ratio(cases),
        }
        for route, environments in run.document["routes"].items()
        for environment, cases in environments.items()
    ]


def _ratio(cases: Mapping[str, Any]) -> float | None:
    """Return the attack's mean error as a multiple of that past random looks."""
    attack, chance = cases.get(ATTACK), cases.get(RANDOM)
    if attack is None or chance is None or not chance["cross_track_mean_m"]:
        return None
    return attack["cross_track_mean_m"] / chance["cross_track_mean_m"]


def _matrix(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the blocks of a transfer's matrix, one an environment.

    Returns:
        ``environment`` and ``lines``, each a label and, by condition, None where
        nothing was driven, or text, colour of the cell and colour of the text.
    """
    names = dict.fromkeys(column["environment"] for column in document["columns"])
    blocks = {name: matrix_lines(document, name) for name in names}
    values = [
        value
        for lines in blocks.values()
        for line in lines
        for value, _ in line.cells.values()
    ]
    most, colours = max([*values, 1e-9]), matplotlib.colormaps[COLOURS]

    def cell(value: float, text: str) -> tuple[str, str, str]:
        share = value / most
        return text, to_hex(colours(share)), "#000" if share > LIGHT else "#fff"

    return [
        {
            "environment": name,
            "lines": [
                (
                    line.label.strip(),
                    [
                        cell(*line.cells[condition])
                        if condition in line.cells
                        else None
                        for condition in document["conditions"]
                    ],
                )
                for line in lines
            ],
        }
        for name, lines in blocks.items()
    ]


def _beside(
    columns: Sequence[Mapping[str, Any]], names: Mapping[str, str] | None = None
) -> dict[str, list[Any]]:
    """Lay facts of runs beside each other: by name, a value a run, None if unknown.

    Args:
        columns: facts of each run by key.
        names: of the keys on the page.
    """
    keys = dict.fromkeys(key for column in columns for key in column)
    return {
        (names or {}).get(key, key): [column.get(key) for column in columns]
        for key in keys
    }
