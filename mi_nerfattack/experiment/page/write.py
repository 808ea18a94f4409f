"""Write the page of results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from mi_nerfattack.report.pages.results import RunPart, write_results_page
from mi_nerfattack.report.plots import convergence as plots


def write_page(path: Path, runs: Sequence[RunPart], title: str | None = None) -> None:
    """Write one HTML file, atomically.

    Args:
        path: of the file.
        runs: at least one.
        title: of the page; names of the runs by default.
    """
    with TemporaryDirectory() as folder:
        damage = _damage(Path(folder), runs) if len(runs) > 1 else {}
        write_results_page(path, title or _title(runs), runs, damage)


def _title(runs: Sequence[RunPart]) -> str:
    names = list(dict.fromkeys(run.document["scenario"]["name"] for run in runs))
    return ", ".join(names) if len(names) < 4 else f"{len(runs)} runs"


def _damage(folder: Path, runs: Sequence[RunPart]) -> dict[str, Path]:
    """Plot what attacks found against its cost, a plot a route."""
    routes: dict[str, dict[str, plots.Curves]] = {}
    for run in runs:
        if (curve := run.document.get("curve")) is not None:
            (route,) = run.document["routes"]
            method = run.document["scenario"]["attack"]["method"]
            methods = routes.setdefault(route, {})
            methods.setdefault(method, []).append(curve)
    found = {}
    for number, (route, methods) in enumerate(routes.items()):
        path = folder / f"damage_{number}.png"
        plots.damage(path, methods)
        found[f"Damage against frames, {route}"] = path
    return found
