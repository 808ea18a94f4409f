"""The page of results: one HTML file that needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import render
from mi_nerfattack.report.pages.scrubber import Scrubber
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
#: Sections of a page that have pictures of each run, with what the folder may lack.
ABOVE, COST, SEEN, TEXTURES, WHEN = "above", "cost", "seen", "textures", "when"


@dataclass(frozen=True, eq=False)
class RunPart:
    """A finished run, as a page shows it.

    Attributes:
        label: that tells it from the others.
        document: as of `metrics.metrics_document`, with all that follows.
        scenario: the scenario file as run.
        made_with: version of each program by its name.
        digests: SHA-256 of files by their keys.
        repeat: the command that makes the run again.
        pictures: image files by title, by section.
        scrubbers: by section.
        missing: by section, why there is nothing, and what makes it.
    """

    label: str
    document: Mapping[str, Any]
    scenario: str
    made_with: Mapping[str, str]
    digests: Mapping[str, str]
    repeat: str
    pictures: Mapping[str, Mapping[str, Path]]
    scrubbers: Mapping[str, Sequence[Scrubber]]
    missing: Mapping[str, str]


def write_results_page(
    path: str | Path, title: str, runs: Sequence[RunPart], damage: Mapping[str, Path]
) -> None:
    """Write a self-contained HTML page, atomically.

    Args:
        path: HTML file.
        title: of the page.
        runs: what it shows.
        damage: plots of several runs by title.
    """
    text = render(
        "results.html.j2",
        title=title,
        runs=runs,
        headline=[row for run in runs for row in _headline(run)],
        damage=damage,
        cost=_beside([run.document["cost"] for run in runs], _COST_LABELS),
        made_with=_beside([run.made_with for run in runs]),
        digests=_beside([run.digests for run in runs]),
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
