"""The run's report: one HTML file that needs no network and no other file."""

from __future__ import annotations

import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import STYLE, figure, page, pairs

_PAGE = page(
    """<p>Seed $seed. Distances are measured from the lane centre. A step departs when
the car touches the edge of its lane.</p>""",
    """<h2>Metrics</h2>
<div class="scroll">$metrics</div>
$figures
<h2>Cost</h2>
<div class="scroll">$cost</div>
<h2>Versions</h2>
<div class="scroll">$versions</div>
<h2>Scenario</h2>
<pre>$scenario</pre>""",
)

_COLUMNS = {
    "n": "runs",
    "cross_track_mean_m": "mean (m)",
    "cross_track_mean_ci95_m": "95 % interval (m)",
    "cross_track_max_m": "maximum (m)",
    "cross_track_total": "total (m × steps)",
    "departures": "steps departed",
}
_COST_LABELS = {
    "wall_s": "wall time (s)",
    "peak_memory_mb": "peak memory (MB)",
    "renders": "frames rendered",
    "checkpoint_s": "of the wall time, in checkpoints (s)",
    "processes": "processes, one and one a resumption",
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
    cost: Mapping[str, Any] = document["cost"]
    text = _PAGE.substitute(
        title=html.escape(f"Attack report: {', '.join(document['routes'])}"),
        style=STYLE,
        seed=html.escape(str(document["seed"])),
        metrics=_metrics(document["routes"]),
        figures="\n".join(figure(title, file) for title, file in images.items()),
        cost=pairs({_COST_LABELS.get(k, k): v for k, v in cost.items()}),
        versions=pairs(versions),
        scenario=html.escape(scenario_text),
    )
    files.write_text(path, text)


def _metrics(routes: Mapping[str, Any]) -> str:
    names = "".join(f"<th>{name}</th>" for name in ("route", "environment", "case"))
    names += "".join(f'<th class="number">{n}</th>' for n in _COLUMNS.values())
    body = "\n".join(
        _row(route, environment, case, figures, first=index == 0)
        for route, environments in routes.items()
        for environment, cases in environments.items()
        for index, (case, figures) in enumerate(cases.items())
    )
    caption = (
        "Mean and maximum over all steps and runs; the interval is a bootstrap over "
        "runs; the total is the plain sum over the steps of a run, averaged over runs; "
        "steps departed are summed over runs."
    )
    return (
        f"<table><caption>{caption}</caption>\n<thead><tr>{names}</tr></thead>\n"
        f"<tbody>\n{body}\n</tbody></table>"
    )


def _row(
    route: str, environment: str, case: str, figures: Mapping[str, Any], first: bool
) -> str:
    labels = [route, environment] if first else ["", ""]
    cells = [f"<td>{html.escape(label)}</td>" for label in [*labels, case]]
    for name in _COLUMNS:
        value = figures.get(name)
        kind = "number bad" if name == "departures" and value else "number"
        cells.append(f'<td class="{kind}">{_number(value)}</td>')
    start = '<tr class="first">' if first else "<tr>"
    return start + "".join(cells) + "</tr>"


def _number(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, list | tuple):
        return " to ".join(_number(item) for item in value)
    text = f"{value:.3f}" if isinstance(value, float) else str(value)
    return html.escape(text)
