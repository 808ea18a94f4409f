"""Maps: lanes, objects and drives from above, over paper or over a rendered ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from mi_nerfattack.report.plots.charts import DPI, RC, WIDTH_PX, save
from mi_nerfattack.report.plots.drives import (
    by_name,
    case_label,
    crosses,
    drawing_order,
    legend_below,
    line_style,
)
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.vehicle.route.route import Route

OBJECT = "#F0C000"
_LANE, _EDGE, _CENTRE = "#ececec", "#b5b5b5", "#9a9a9a"
_SAMPLES = 240  # of a route

#: Left, right, bottom and top on the ground, metres.
Extent = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Panel:
    """One map.

    Attributes:
        title: above it.
        drives: on it.
        footprints: corners (n, 2) of each object on the ground, metres.
        ground: (h, w, 3), uint8, rendered from above; None for paper.
    """

    title: str
    drives: Sequence[Drive]
    footprints: Sequence[np.ndarray]
    ground: np.ndarray | None = None


def overhead(
    path: str | Path,
    drives: Sequence[Drive],
    route: Route,
    object_footprints: Sequence[np.ndarray],
    limit: float,
) -> None:
    """Plot the drives of one route from above, a panel per environment.

    Args:
        path: PNG file.
        drives: of one route; the steps beyond the limit are marked with crosses.
        route: with its lane.
        object_footprints: corners of each object on the ground, (n, 2), metres.
        limit: departure limit, metres.
    """
    groups: dict[str, list[Drive]] = {}
    for (environment, *_), group in by_name(drives).items():
        groups.setdefault(environment, []).extend(group)
    points = np.concatenate([*(d.states[:, :2] for d in drives), *object_footprints])
    margin = max(0.75 * route.lane_width_m, 1.0)
    (left, bottom), (right, top) = points.min(0) - margin, points.max(0) + margin
    panels = [
        Panel(f"{route.name}: {name}", group, object_footprints)
        for name, group in groups.items()
    ]
    write_maps(path, panels, route, limit=limit, extent=(left, right, bottom, top))


def write_maps(
    path: str | Path,
    panels: Sequence[Panel],
    route: Route,
    limit: float,
    extent: Extent,
) -> None:
    """Plot maps of one piece of ground.

    Args:
        path: PNG file.
        panels: next to each other, or above each other where the piece of ground is
            wide. All of them have a ground, or none has one.
        route: with its lane.
        limit: departure limit, metres; steps beyond are marked with crosses.
        extent: of the piece, and of all grounds.

    Source: appendix, figure C.3.
    """
    on_ground = panels[0].ground is not None
    title_size = "large" if len(panels) <= 3 else "medium"
    with matplotlib.rc_context(RC | {"axes.titlesize": title_size}):
        figure, axes = _axes(len(panels), extent)
        for axis, panel in zip(axes, panels, strict=True):
            if panel.ground is not None:
                axis.imshow(panel.ground, extent=extent, interpolation="nearest")
            draw_lane(axis, route, on_ground)
            draw_objects(axis, panel.footprints, on_ground)
            for drive in sorted(panel.drives, key=drawing_order):
                style = line_style(drive.case)
                if on_ground:
                    edge = withStroke(
                        linewidth=style["linewidth"] + 1.5, foreground="w"
                    )
                    style |= {"linestyle": "-", "path_effects": [edge]}
                label = case_label(drive.case)
                axis.plot(*drive.states[:, :2].T, label=label, **style)
                out = drive.states[1:][drive.departed(limit)]
                label = f"departed (> {limit:.2f} m)" if len(out) else None
                axis.plot(out[:, 0], out[:, 1], label=label, **crosses(drive.case))
            frame_map(axis, panel.title, extent)
        legend_below(figure, axes)
        save(path, figure)


def _axes(count: int, extent: Extent) -> tuple[Figure, Any]:
    """Place panels above each other where the map is wide, else beside each other."""
    left, right, bottom, top = extent
    width_in = WIDTH_PX / DPI
    aspect = (top - bottom) / (right - left)
    rows = count if aspect < 0.6 else 1
    columns = count // rows
    panel_in = (width_in - 0.7 * columns) / columns * aspect
    height_in = min(rows * (max(panel_in, 1.0) + 0.65) + 0.6, 14.0)
    figure = Figure((width_in, height_in), DPI, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def lane_lines(route: Route) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centre, the left and the right border of a lane, (n, 2) each."""
    x, y, theta = route.pose_at(np.linspace(0, route.length, _SAMPLES)).T
    centre, half = np.stack([x, y], axis=1), route.lane_width_m / 2
    offset = half * np.stack([-np.sin(theta), np.cos(theta)], axis=1)
    return centre, centre + offset, centre - offset


def draw_lane(axis: Axes, route: Route, on_ground: bool = False) -> None:
    """Draw a lane's borders; over paper, its surface and its centre, too."""
    centre, left, right = lane_lines(route)
    if on_ground:
        for edge in (left, right):
            axis.plot(*edge.T, color="black", alpha=0.6, linewidth=2.2)
            axis.plot(*edge.T, color="white", linewidth=1.0, linestyle=(0, (4, 2)))
        axis.plot([], [], color="#8a8a8a", linestyle="--", label="lane borders")
        return
    surface = np.concatenate([left, right[::-1]])
    style = {"facecolor": _LANE, "edgecolor": _EDGE, "linewidth": 0.8, "zorder": 0}
    axis.fill(*surface.T, label="lane", **style)
    style = {"color": _CENTRE, "linewidth": 1, "linestyle": "--", "zorder": 2}
    axis.plot(*centre.T, label="lane centre", **style)


def draw_objects(
    axis: Axes, footprints: Sequence[np.ndarray], on_ground: bool = False
) -> None:
    """Draw outlines (n, 2) of objects; over paper, filled."""
    style: dict[str, Any] = {"facecolor": OBJECT, "edgecolor": "black", "zorder": 6}
    if on_ground:
        style = {"fill": False, "edgecolor": OBJECT, "linewidth": 2, "zorder": 7}
    for outline in footprints:
        axis.fill(*outline.T, label="object's box", **style)


def frame_map(axis: Axes, title: str, extent: Extent | None = None) -> None:
    """Give a map equal axes, their labels and a title.

    Args:
        axis: with the map.
        title: above it.
        extent: of what is shown; None for all that is drawn.
    """
    shape: Literal["box", "datalim"] = "datalim"
    if extent is not None:
        axis.set_xlim(extent[:2])
        axis.set_ylim(extent[2:])
        shape = "box"
    axis.set_aspect("equal", adjustable=shape)
    axis.set_title(title)
    axis.set_xlabel("x (m)")
    axis.set_ylabel("y (m)")
