"""The report of a comparison: how close a field is to the scene it stands for."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import rich.box
from matplotlib.lines import Line2D
from rich.table import Table

from mi_nerfattack.evaluation.field_and_scene import (
    ComparedFrame,
    Comparison,
    RouteComparison,
)
from mi_nerfattack.fit.scores import HAZY
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import render
from mi_nerfattack.report.pages.fit import finite
from mi_nerfattack.report.plots.charts import PALETTE, chart
from mi_nerfattack.report.plots.views import ViewPair, write_colours, write_depths

MIN_PSNR_DB = 26.0  # mean along a route
MAX_DEPTH_M = 0.1  # median error along a route, near the camera
MAX_HOLES = 0.005  # share of the scene's surfaces, mean along a route


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
    files.write_json(root / "metrics.json", document(comparison))
    write_along(root / "along.png", comparison)
    text = render(
        "compare.html.j2",
        title=title,
        verdict=verdict(comparison),
        columns=COLUMNS,
        rows=list(zip(rows(comparison), map(_bad, comparison.routes), strict=True)),
        settings=settings_line(comparison),
        along=root / "along.png",
        frames=[_frames(root, route) for route in comparison.routes if route.worst],
    )
    files.write_text(root / "report.html", text)
    return root / "report.html"


def document(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as JSON has it; what is not finite becomes null."""
    options = comparison.options
    table = {
        "routes": {route.name: _route_entry(route) for route in comparison.routes},
        "settings": {
            "camera": asdict(options.camera),
            "mount": asdict(options.mount),
            "spacing_m": options.spacing_m,
            "lateral_m": options.lateral_m,
            "spp": options.spp,
            "near_m": options.near_m,
            "seed": options.seed,
        },
        "close_enough": not _far(comparison),
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
        "stations": [asdict(station) for station in route.stations],
    }


def verdict(comparison: Comparison) -> str:
    """Say in words whether the field is close enough to attack a policy in."""
    wanted = (
        f"at least {MIN_PSNR_DB:g} dB on average along each route, a median depth "
        f"error of at most {MAX_DEPTH_M:g} m within {comparison.options.near_m:g} m, "
        f"and holes in at most {100 * MAX_HOLES:g} % of the scene's surfaces"
    )
    far = _far(comparison)
    if not far:
        return f"Close enough: {wanted}."
    noisy = [route.name for route in comparison.routes if _is_noise(route)]
    advice = []
    if noisy:
        advice.append(
            f"The scene's frames are too noisy on {', '.join(noisy)}; compare with "
            "more samples per pixel."
        )
    if noisy != far:
        advice.append(
            "Capture more views where the frames are worst, and fit for longer."
        )
    return (
        f"Not close enough on {', '.join(far)}: {wanted} are needed. What is found in "
        f"the field may not hold in the scene. {' '.join(advice)}"
    )


def _far(comparison: Comparison) -> list[str]:
    return [
        route.name
        for route in comparison.routes
        if not (_is_psnr_good(route) and _is_geometry_good(route))
    ]


def _is_psnr_good(route: RouteComparison) -> bool:
    return route.mean("psnr_db") >= MIN_PSNR_DB


def _is_noise(route: RouteComparison) -> bool:
    """Whether the noise of the scene's frames is all that is wrong with a route."""
    if _is_psnr_good(route) or not _is_geometry_good(route):
        return False
    error, noise = (
        10 ** (-0.1 * route.mean(name)) for name in ("psnr_db", "ceiling_db")
    )
    return error - noise <= 10 ** (-0.1 * MIN_PSNR_DB)


def _is_depth_good(route: RouteComparison) -> bool:
    """A route with nothing near has no depth to be wrong."""
    return math.isnan(route.depth_median_m) or route.depth_median_m <= MAX_DEPTH_M


def _is_solid(route: RouteComparison) -> bool:
    """A route without surfaces has none to see through."""
    holes = route.mean("holes")
    return math.isnan(holes) or holes <= MAX_HOLES


def _is_geometry_good(route: RouteComparison) -> bool:
    return _is_depth_good(route) and _is_solid(route)


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


def rows(comparison: Comparison) -> list[list[str]]:
    """Return the cells of a table of the routes, below `COLUMNS`."""
    result = []
    for route in comparison.routes:
        metres = f"{_number(route.depth_median_m, 3)} / {_number(route.depth_p90_m, 3)}"
        relative = _number(100 * route.depth_median_relative, 1)
        relative += f" / {_number(100 * route.depth_p90_relative, 1)}"
        result.append(
            [
                route.name,
                f"{route.mean('psnr_db'):.1f} / {route.least('psnr_db'):.1f}",
                f"{route.mean('ssim'):.2f} / {route.least('ssim'):.2f}",
                metres,
                relative,
                f"{100 * route.mean('wrong'):.2f}",
                _number(100 * route.mean("holes"), 2),
                f"{100 * route.mean('hazy'):.2f}",
            ]
        )
    return result


_PSNR, _DEPTH = "PSNR (dB)\nmean / min", "depth error (m)\nmedian / 90 %"
_HOLES = "holes\n(%)"
COLUMNS = (
    "route",
    _PSNR,
    "SSIM\nmean / min",
    _DEPTH,
    "relative (%)\nmed. / 90 %",
    "wrong\n(%)",
    _HOLES,
    "hazy\n(%)",
)


def routes_table(comparison: Comparison) -> Table:
    """Return the figures of the routes as a table for a terminal."""
    table = Table(box=rich.box.SIMPLE_HEAD, pad_edge=False, padding=0)
    for i, name in enumerate(COLUMNS):
        table.add_column(name, justify="right" if i else "left", no_wrap=i > 0)
    for cells in rows(comparison):
        table.add_row(*cells)
    return table


def _number(value: float, digits: int) -> str:
    if math.isnan(value):
        return "–"
    return "nothing shown" if math.isinf(value) else f"{value:.{digits}f}"


def _bad(route: RouteComparison) -> set[int]:
    """Return the columns in which a route is too far off."""
    good = {
        _PSNR: _is_psnr_good(route),
        _DEPTH: _is_depth_good(route),
        _HOLES: _is_solid(route),
    }
    return {COLUMNS.index(name) for name in good if not good[name]}


def _frames(root: Path, route: RouteComparison) -> tuple[str, Path, Path]:
    """Write the worst frames of a route; return its name and the two pictures."""
    views = [_pair(frame) for frame in route.worst]
    colours, depths = (
        root / f"{_file_name(route.name)}_{kind}.png" for kind in ("worst", "depth")
    )
    write_colours(colours, views, "scene, path-traced")
    write_depths(depths, views)
    return route.name, colours, depths


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)


def _pair(frame: ComparedFrame) -> ViewPair:
    at = frame.station
    title = f"at {at.arc_m:.1f} m: {at.psnr_db:.2f} dB, SSIM {at.ssim:.3f}"
    shown = frame.field
    return ViewPair(
        title, frame.image, shown.image, shown.opacity, shown.depth, frame.depth
    )


def write_along(path: str | Path, comparison: Comparison) -> None:
    """Plot PSNR, SSIM, depth error and wrong opacity against the arc length."""
    with chart(path, 7.2) as figure:
        axes = figure.subplots(4, 1, sharex=True)
        labels = ("PSNR (dB)", "SSIM", "depth error (m)", "rays (%)")
        handles: list[Any] = []
        for i, route in enumerate(comparison.routes):
            style = {"color": PALETTE[i % len(PALETTE)], "linewidth": 1.6}
            handles.append(Line2D([], [], label=route.name, **style))
            arc = [station.arc_m for station in route.stations]
            for axis, name, dash, factor in _LINES:
                values = [factor * getattr(at, name) for at in route.stations]
                axes[axis].plot(arc, values, linestyle=dash, **style)
        for axis, label in zip(axes, labels, strict=True):
            axis.set_ylabel(label)
            axis.grid(alpha=0.25)
        axes[0].axhline(MIN_PSNR_DB, color="black", linewidth=1, linestyle=":")
        axes[2].axhline(MAX_DEPTH_M, color="black", linewidth=1, linestyle=":")
        axes[2].set_ylim(bottom=0)
        axes[3].set_ylim(bottom=0)
        _title(axes[2], "solid: median; dashed: 90 % of the near rays")
        _title(axes[3], "solid: wrong opacity; dashed: hazy")
        axes[-1].set_xlabel("arc length (m)")
        figure.align_ylabels()
        figure.legend(handles=handles, loc="outside upper center", ncols=6)


_LINES = (
    (0, "psnr_db", "-", 1.0),
    (1, "ssim", "-", 1.0),
    (2, "depth_median_m", "-", 1.0),
    (2, "depth_p90_m", "--", 1.0),
    (3, "wrong", "-", 100.0),
    (3, "hazy", "--", 100.0),
)


def _title(axis: Any, text: str) -> None:
    axis.set_title(text, loc="right", fontsize=8, color="#555555")
