"""Write the page of results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_nerfattack.report.pages.parts import Parts
from mi_nerfattack.report.pages.results import write_results_page
from mi_nerfattack.report.plots import convergence as plots
from mi_nerfattack.rollout.drive import ATTACK

#: Keys of `[attack]` that limit textures, and their largest values.
_LIMITS = {"linf": 1.0, "l2": 1.0}


def write_page(
    path: Path, parts: Parts, scratch: Path, title: str | None = None
) -> None:
    """Write one HTML file, atomically.

    Args:
        path: of the file.
        parts: what it shows.
        scratch: folder for plots that are made for the page.
        title: of the page; names of what it shows by default.
    """
    damage = {**_damage(scratch, parts), **_by_limit(scratch, parts)}
    write_results_page(path, title or _title(parts), replace(parts, damage=damage))


def _title(parts: Parts) -> str:
    names = [run.document["scenario"]["name"] for run in parts.runs]
    groups = parts.sweeps, parts.transfers, parts.retrainings
    for word, group in zip(("sweep", "transfer", "retraining"), groups, strict=True):
        names += [f"{word} {part.label}" for part in group]
    names = list(dict.fromkeys(names))
    return ", ".join(names) if len(names) < 4 else f"{len(names)} results"


def _damage(scratch: Path, parts: Parts) -> dict[str, Path]:
    """Plot what attacks found against its cost, a plot a route; of one, nothing."""
    routes: dict[str, dict[str, plots.Curves]] = {}
    for route, method, curve in _curves(parts):
        if curve is not None:
            routes.setdefault(route, {}).setdefault(method, []).append(curve)
    found = {}
    for route, methods in routes.items():
        if sum(map(len, methods.values())) > 1:
            path = scratch / f"damage_{len(found)}.png"
            plots.damage(path, methods)
            found[f"Damage against frames, {route}"] = path
    return found


def _curves(parts: Parts) -> Iterator[tuple[str, str, Any]]:
    """Yield route, method and curve of every attack."""
    for run in parts.runs:
        for route in run.document["routes"]:
            method = run.document["scenario"]["attack"]["method"]
            yield route, method, run.document.get("curve")
    for sweep in parts.sweeps:
        for attack in sweep.document["attacks"]:
            words = attack["method"], attack["budget"]
            method = " ".join(str(word) for word in words if word is not None)
            yield attack["route"], method, attack["curve"]


def _by_limit(scratch: Path, parts: Parts) -> dict[str, Path]:
    """Plot what attacks did against what their textures might change."""
    found = {}
    for key, most in _LIMITS.items():
        points: dict[str, list[tuple[float, float]]] = {}
        for environment, attack, error in _attacked(parts):
            limit = attack.get(key)
            at = most if limit is None else limit
            points.setdefault(environment, []).append((at, error))
        if len({at for own in points.values() for at, _ in own}) > 1:
            path = scratch / f"limit_{key}.png"
            label = f"attack.{key}, sRGB (without one: {most:g})"
            plots.against_limit(path, label, points)
            found[f"Damage against the texture's budget, {key}"] = path
    return found


def _attacked(parts: Parts) -> Iterator[tuple[str, Mapping[str, Any], float]]:
    """Yield environment, section `attack` and mean error of every attack."""
    for run in parts.runs:
        section = run.document["scenario"]["attack"]
        for environments in run.document["routes"].values():
            for environment, cases in environments.items():
                if ATTACK in cases:
                    yield environment, section, cases[ATTACK]["cross_track_mean_m"]
    for sweep in parts.sweeps:
        for row in sweep.attacks:
            if ATTACK in row["cases"] and row["section"] is not None:
                yield row["environment"], row["section"], row["cases"][ATTACK]
