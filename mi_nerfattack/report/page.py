"""The run's report: one HTML file that needs no network and no other file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

from PIL import Image

from mi_nerfattack import files

_STYLE = """
:root { color-scheme: light dark; --ink: #1c1e21; --paper: #ffffff; --soft: #5c636b;
  --rule: #d9dde2; --tint: #f4f6f8; --bad: #b34700; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8eb; --paper: #15181c;
  --soft: #9aa3ad; --rule: #343a42; --tint: #1e2329; --bad: #ff9d5c; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 72rem; color: var(--ink);
  background: var(--paper); font: 1rem/1.55 system-ui, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .7rem; }
p, figcaption, caption { color: var(--soft); max-width: 46rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding-bottom: .5rem; }
th, td { padding: .35rem .9rem .35rem 0; text-align: left; vertical-align: baseline;
  border-bottom: 1px solid var(--rule); white-space: nowrap; }
thead th { color: var(--soft); font-weight: 600; border-bottom-width: 2px; }
td.number, th.number { text-align: right; }
td.bad { color: var(--bad); font-weight: 600; }
tr.first td { border-top: 2px solid var(--rule); }
figure { margin: 0 0 1.8rem; }
figcaption { margin-bottom: .5rem; font-weight: 600; }
img { max-width: 100%; height: auto; display: block; background: #fff;
  border: 1px solid var(--rule); border-radius: 6px; }
pre { background: var(--tint); border: 1px solid var(--rule); border-radius: 6px;
  padding: .9rem 1rem; overflow-x: auto; font: .85rem/1.5 ui-monospace, Menlo, Consolas,
  "DejaVu Sans Mono", monospace; }
@media print { body { max-width: none; } figure, tr { break-inside: avoid; } }
"""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>$style</style>
</head>
<body>
<header>
<h1>$title</h1>
<p>Seed $seed. Distances are measured from the lane centre. A step departs when the
car touches the edge of its lane.</p>
</header>
<main>
<h2>Metrics</h2>
<div class="scroll">$metrics</div>
$figures
<h2>Cost</h2>
<div class="scroll">$cost</div>
<h2>Versions</h2>
<div class="scroll">$versions</div>
<h2>Scenario</h2>
<pre>$scenario</pre>
</main>
</body>
</html>
""")

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
        style=_STYLE,
        seed=html.escape(str(document["seed"])),
        metrics=_metrics(document["routes"]),
        figures="\n".join(_figure(title, file) for title, file in images.items()),
        cost=_pairs({_COST_LABELS.get(k, k): v for k, v in cost.items()}),
        versions=_pairs(versions),
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


def _pairs(values: Mapping[str, Any]) -> str:
    rows = "\n".join(_pair(name, value) for name, value in values.items())
    return f"<table><tbody>\n{rows}\n</tbody></table>"


def _pair(name: str, value: Any) -> str:
    text = f"{value:,.1f}" if isinstance(value, float) else str(value)
    return (
        f"<tr><td>{html.escape(str(name))}</td>"
        f'<td class="number">{html.escape(text)}</td></tr>'
    )


def _figure(title: str, path: str | Path) -> str:
    buffer = io.BytesIO()
    Image.fromarray(files.read_image(path)).save(buffer, "PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    text = html.escape(title)
    return (
        f'<figure><figcaption>{text}</figcaption>\n<img alt="{text}" '
        f'src="data:image/png;base64,{data}"></figure>'
    )
