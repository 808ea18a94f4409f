"""The report of a comparison: how close a field is to the scene that it shows."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from mi_nerfattack.evaluation.field_and_scene import Comparison, RouteComparison
from mi_nerfattack.fit.scores import HAZY, worst_views
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import finite
from mi_nerfattack.report.columns import Column, Table
from mi_nerfattack.report.pages.sections import Block, Picture, write_report
from mi_nerfattack.report.pages.verdict import (
    MAX_DEPTH_M,
    MIN_PSNR_DB,
    ROUTE,
    Criterion,
    judge,
    verdict,
)
from mi_nerfattack.report.plots.views import write_along, write_colours, write_depths

_PSNR, _DEPTH = "PSNR (dB)\nmean / min", "depth error (m)\nmedian / 90 %"
_HOLES, _FOG = "holes\n(%)", "hazy\n(%)"
_ROUTES = (
    Column("route", "{name}"),
    Column(_PSNR, "{psnr_mean_db:.1f} / {psnr_min_db:.1f}"),
    Column("SSIM\nmean / min", "{ssim_mean:.2f} / {ssim_min:.2f}"),
    Column(_DEPTH, "{depth_median_m:.3f} / {depth_p90_m:.3f}"),
    Column(
        "relative (%)\nmed. / 90 %",
        "{depth_median_relative:.1%} / {depth_p90_relative:.1%}",
    ),
    Column("wrong\n(%)", "{wrong_opacity:.2%}"),
    Column(_HOLES, "{holes:.2%}"),
    Column(_FOG, "{hazy:.2%}"),
)
_STATION = "arc_m psnr_db ceiling_db ssim depth_median_m depth_p90_m wrong hazy holes"
_NOISY = "The scene's frames are too noisy: compare with more samples per pixel."
#: Columns of the figures that have a limit.
_LIMITED = {
    "psnr_db": _PSNR,
    "psnr_min_db": _PSNR,
    "depth_median_m": _DEPTH,
    "holes": _HOLES,
    "hazy": _FOG,
}


def write_compare_report(folder: Path, comparison: Comparison, title: str) -> Path:
    """Write `report.html`, `metrics.json`, `along.png` and two pictures a route.

    Args:
        folder: made if needed; files of these names are replaced.
        comparison: what to show.
        title: of the page.

    Returns:
        Path of the page, which is written last.
    """
    root = files.make_folder(folder)
    limits = {"psnr_db": MIN_PSNR_DB, "depth_median_m": MAX_DEPTH_M}
    write_along(root / "along.png", comparison.routes, limits)
    sections: dict[str, list[Block]] = {
        "Routes": [routes_table(comparison), settings_line(comparison)],
        "Along the routes": [
            Picture("agreement frame by frame", root / "along.png"),
        ],
    }
    for route in comparison.routes:
        if worst := worst_views(route.stations):
            stem = "".join(c if c.isalnum() or c in "-_" else "_" for c in route.name)
            colours, depths = root / f"{stem}_worst.png", root / f"{stem}_depth.png"
            write_colours(colours, worst, "scene, path-traced")
            write_depths(depths, worst)
            text = "depth of the field, of the scene, and their difference"
            sections[f"Worst frames of {route.name}"] = [
                Picture("scene, field, and their difference", colours),
                Picture(text, depths),
            ]
    text = verdict(judge_routes(comparison))
    return write_report(
        root, title, text, metrics=document(comparison), sections=sections
    )


def document(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as JSON has it; what is not finite becomes null."""
    settings = asdict(comparison.options)
    del settings["worst"]
    table = {
        "routes": {route.name: _route_entry(route) for route in comparison.routes},
        "settings": settings,
        "good_enough": all(item.met for item in judge_routes(comparison)),
        "wall_s": comparison.wall_s,
    }
    return finite(table)


def _route_entry(route: RouteComparison) -> dict[str, Any]:
    return {
        "length_m": route.length_m,
        "frames": len(route.stations),
        "psnr_mean_db": route.mean("psnr_db"),
        "psnr_min_db": route.least("psnr_db"),
        "psnr_ceiling_db": route.mean("ceiling_db"),
        "ssim_mean": route.mean("ssim"),
        "ssim_min": route.least("ssim"),
        "depth_median_m": route.depth_median_m,
        "depth_p90_m": route.depth_p90_m,
        "depth_median_relative": route.depth_median_relative,
        "depth_p90_relative": route.depth_p90_relative,
        "near_share": route.near,
        "wrong_opacity": route.mean("wrong"),
        "holes": route.mean("holes"),
        "hazy": route.mean("hazy"),
        "stations": [station.entry(_STATION) for station in route.stations],
    }


def judge_routes(comparison: Comparison) -> list[Criterion]:
    """Judge the field along each route, by the criteria of a fit."""
    return [
        replace(item, name=f"{item.name} on {route.name}")
        for route in comparison.routes
        for item in _judged(route)
    ]


def _judged(route: RouteComparison) -> list[Criterion]:
    """Judge one route; where noise alone is wrong, the advice is less of it."""
    criteria = judge(route.stations, subject=ROUTE, depth_m=route.depth_median_m)
    error, noise = (
        10 ** (-0.1 * route.mean(name)) for name in ("psnr_db", "ceiling_db")
    )
    is_noise = error - noise <= 10 ** (-0.1 * MIN_PSNR_DB)
    if is_noise and [item.figure for item in criteria if not item.met] == ["psnr_db"]:
        criteria = [replace(item, advice=_NOISY) for item in criteria]
    return criteria


def settings_line(comparison: Comparison) -> str:
    """State what was compared, in one sentence."""
    options, camera = comparison.options, comparison.options.camera
    frames = sum(len(route.stations) for route in comparison.routes)
    ceiling = min(route.mean("ceiling_db") for route in comparison.routes)
    noise = f"whose noise alone leaves {ceiling:.1f} dB"
    if math.isinf(ceiling):
        noise = "without noise"
    return (
        f"{frames} frames of {camera.width} x {camera.height} px, {options.spacing_m:g}"
        f" m apart, {options.lateral_m:g} m left of the route; the scene with "
        f"{options.spp} samples per pixel, {noise}; the field with one ray per pixel, "
        f"as an attack sees it. Depth where the scene is nearer than {options.near_m:g}"
        " m. Wrong: rays that only one of the two stops; holes: those that the field "
        "lets through, of all that meet the scene in its box; hazy: those with an "
        f"opacity in the field from {HAZY[0]:g} to {HAZY[1]:g}. "
        f"{comparison.wall_s:.0f} s."
    )


def _faults(route: RouteComparison) -> set[str]:
    """Return the columns in which a route is not good enough."""
    failed = [item.figure for item in _judged(route) if not item.met]
    return {_LIMITED[figure] for figure in failed if figure in _LIMITED}


def routes_table(comparison: Comparison) -> Table:
    """Return a table with the figures of each route."""
    rows = [
        {**_route_entry(route), "name": route.name, "bad": _faults(route)}
        for route in comparison.routes
    ]
    return Table.of(rows, _ROUTES)
