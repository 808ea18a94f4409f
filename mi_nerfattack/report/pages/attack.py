"""The run's report: one HTML file that needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import render

_COST_LABELS = {
    "wall_s": "wall time (s)",
    "peak_memory_mb": "peak memory (MB)",
    "renders": "frames rendered",
    "checkpoint_s": "of the wall time, in checkpoints (s)",
    "processes": "processes, one and one a resumption",
    "forward_s": "of the wall time, in the attack's drives (s)",
    "backward_s": "of the wall time, in the passes back through them (s)",
}


def write_report(
    path: str | Path,
    document: Mapping[str, Any],
    images: Mapping[str, str | Path],
    scenario_text: str,
    versions: Mapping[str, str],
) -> None:
    """Write a self-contained HTML page, atomically.

    Args:
        path: HTML file.
        document: as of `metrics.metrics_document`.
        images: image file of each figure by its title; embedded as PNG.
        scenario_text: the scenario file as run.
        versions: version of each program by its name.
    """
    text = render(
        "attack.html.j2",
        title=document["scenario"]["name"],
        seed=document["seed"],
        verdict=document.get("verdict", ()),
        flags=document["flags"],
        textures=document.get("textures"),
        routes=document["routes"],
        baseline=document.get("baseline"),
        images=images,
        cost={_COST_LABELS.get(k, k): v for k, v in document["cost"].items()},
        versions=versions,
        scenario=scenario_text,
    )
    files.write_text(path, text)
