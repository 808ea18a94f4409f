"""Plots of drives, written as PNG files.

Colours stay apart for colour-blind readers (after Okabe and Ito 2008) and are drawn
with different widths and dashes too. Figures are 1200 pixels wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from mi_nerfattack.evaluation.metrics import environment_order
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.report.plots.charts import (
    BLUE,
    DPI,
    GREY,
    ORANGE,
    RC,
    WIDTH_PX,
    chart,
    save,
)
from mi_nerfattack.rollout.drive import (
    ATTACK,
    BEST_RANDOM,
    CASES,
    NO_OBJECT,
    OWN,
    RANDOM,
    Drive,
)

_STYLES: dict[str, dict[str, Any]] = {
    RANDOM: {"color": GREY, "linewidth": 0.8, "alpha": 0.75, "zorder": 3},
    NO_OBJECT: {"color": "#00C48F", "linewidth": 0.9, "zorder": 4.2},
    OWN: {"color": BLUE, "linewidth": 2.2, "zorder": 4},
    BEST_RANDOM: {
        "color": "#8A4F7D",
        "linewidth": 1.6,
        "zorder": 4.5,
        "linestyle": (0, (1.5, 1)),
    },
    ATTACK: {
        "color": ORANGE,
        "linewidth": 2.0,
        "zorder": 5,
        "linestyle": (0, (5, 1.2)),
    },
}
#: By case, as ``#rrggbb``.
CASE_COLOURS = {case: str(style["color"]) for case, style in _STYLES.items()}
_LABELS = {case: case.replace("_", " ") for case in CASES}
_DARK = {
    RANDOM: "#4d4d4d",
    NO_OBJECT: "#00523c",
    OWN: "#003f66",
    BEST_RANDOM: "#4a2a43",
    ATTACK: "#7a1f00",
}
_LANE, _CENTRE, _OBJECT, _LIMIT = "#ececec", "#9a9a9a", "#F0C000", "#000000"


def overhead(
    path: str | Path,
    drives: Sequence[Drive],
    route_points: np.ndarray,
    lane_width_m: float,
    object_footprints: Sequence[np.ndarray],
    limit: float,
) -> None:
    """Plot the drives of one route from above, a panel per environment.

    Args:
        path: PNG file.
        drives: of one route; the steps beyond the limit are marked with crosses.
        route_points: (n, 2) with n >= 2, lane centre, metres.
        lane_width_m: lane width, metres.
        object_footprints: corners of each object on the ground, (n, 2), metres.
        limit: departure limit, metres.
    """
    panels = _environments(drives)
    low, high = _view(drives, object_footprints, lane_width_m)
    with matplotlib.rc_context(RC):
        figure, axes = _map_panels(len(panels), low, high)
        for axis, (environment, group) in zip(axes, panels.items(), strict=True):
            draw_lane(axis, route_points, lane_width_m)
            for footprint in object_footprints:
                axis.fill(*footprint.T, facecolor=_OBJECT, edgecolor="black", zorder=6)
            for drive in sorted(group, key=_drawing_order):
                axis.plot(*drive.states[:, :2].T, **_STYLES[drive.case])
                out = drive.states[1:][drive.departed(limit)]
                axis.plot(out[:, 0], out[:, 1], **_cross(drive.case))
            axis.set_xlim(low[0], high[0])
            axis.set_ylim(low[1], high[1])
            axis.set_aspect("equal")
            axis.set_title(f"{drives[0].route}: {environment}", loc="left")
            axis.set_xlabel("x (m)")
            axis.set_ylabel("y (m)")
        _legend_below(figure, _map_handles(drives, bool(object_footprints), limit))
        save(path, figure)


@dataclass(frozen=True, eq=False)
class Panel:
    """Drives of a case in an environment, and what lies beneath them.

    Attributes:
        drives: of one environment and case.
        ground: (h, w, 3), uint8, rendered from above with the objects in it.
        footprints: corners (n, 2) of each object on the ground, metres.
    """

    drives: Sequence[Drive]
    ground: np.ndarray
    footprints: Sequence[np.ndarray]

    @property
    def title(self) -> str:
        """Case and environment."""
        first = self.drives[0]
        case = "unperturbed" if first.case == OWN else _LABELS[first.case]
        return f"{case}, {first.environment}"


def triptych(
    path: str | Path,
    panels: Sequence[Panel],
    overhead: Overhead,
    route_points: np.ndarray,
    lane_width_m: float,
    limit: float,
) -> None:
    """Plot trajectories over rendered ground, a panel per case and environment.

    Args:
        path: PNG file.
        panels: side by side.
        overhead: camera of all grounds.
        route_points: (n, 2), lane centre, metres.
        lane_width_m: lane width, metres.
        limit: departure limit, metres; steps beyond are marked with crosses.

    Source: appendix, figure C.3.
    """
    extent = left, right, bottom, top = overhead.extent
    with matplotlib.rc_context(RC):
        figure, axes = _map_panels(
            len(panels), np.array([left, bottom]), np.array([right, top])
        )
        for k, (axis, panel) in enumerate(zip(axes, panels, strict=True)):
            axis.imshow(panel.ground, extent=extent, interpolation="nearest")
            for border in _borders(route_points, lane_width_m):
                axis.plot(*border.T, color="white", linewidth=0.9, linestyle="--")
            for footprint in panel.footprints:
                axis.fill(*footprint.T, fill=False, edgecolor=_OBJECT, linewidth=1.5)
            for drive in panel.drives:
                style = _style(drive.case, linestyle="-")
                around = [
                    withStroke(linewidth=style["linewidth"] + 1.5, foreground="w")
                ]
                axis.plot(*drive.states[:, :2].T, path_effects=around, **style)
                out = drive.states[1:][drive.departed(limit)]
                axis.plot(out[:, 0], out[:, 1], **_cross(drive.case))
            axis.set_xlim(left, right)
            axis.set_ylim(bottom, top)
            axis.set_aspect("equal")
            size = 12 if len(panels) <= 3 else 9  # points: beside each other
            title = f"({chr(97 + k)}) {panel.title}"
            axis.set_title(title, loc="left", fontsize=size)
            axis.set_xlabel("x (m)")
        axes[0].set_ylabel("y (m)")
        drives = [drive for panel in panels for drive in panel.drives]
        handles = [
            Line2D([], [], label="drive, unperturbed", **_style(OWN)),
            Line2D([], [], label="drive, attack", **_style(ATTACK, linestyle="-")),
            Line2D([], [], color=_CENTRE, linestyle="--", label="lane borders"),
            Patch(fill=False, edgecolor="#c9a800", label="object's box"),
        ]
        if any(np.any(drive.departed(limit)) for drive in drives):
            label = f"departed (> {limit:.2f} m)"
            handles.append(Line2D([], [], label=label, **_cross(ATTACK)))
        _legend_below(figure, handles)
        save(path, figure)


def errors(path: str | Path, drives: Sequence[Drive], limit: float) -> None:
    """Plot the distance from the lane centre over time, a panel per environment.

    Random looks appear as the range over their runs and its mean, both at each
    time over the runs that last so long; the other cases as a line per run.

    Args:
        path: PNG file.
        drives: of one route.
        limit: departure limit, metres.
    """
    panels = _environments(drives)
    with chart(path, 3.3) as figure:
        grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)
        for axis, (environment, group) in zip(grid[0], panels.items(), strict=True):
            _draw_band(axis, [d for d in group if d.case == RANDOM])
            for drive in sorted(group, key=_drawing_order):
                if drive.case != RANDOM:
                    axis.plot(drive.time_s, drive.distance_m, **_STYLES[drive.case])
            axis.axhline(limit, color=_LIMIT, linewidth=1, linestyle=":", zorder=2)
            axis.set_title(f"{drives[0].route}: {environment}", loc="left")
            axis.set_xlabel("time (s)")
            axis.set_ylim(bottom=0)
            axis.set_xlim(left=0)
            axis.grid(alpha=0.25)
        grid[0][0].set_ylabel("distance from lane centre (m)")
        handles: list[Any] = []
        for case in _cases(drives):
            style = _style(case, linewidth=2)
            handles.append(Line2D([], [], label=_LABELS[case], **style))
            if case == RANDOM:
                handles[-1].set_label("random, mean")
                band = {"facecolor": _STYLES[case]["color"], "alpha": 0.25}
                handles.append(Patch(label="random, range", **band))
        label = f"departure limit {limit:.2f} m"
        handles.append(Line2D([], [], color=_LIMIT, linestyle=":", label=label))
        _legend_below(figure, handles)


def control_change(
    path: str | Path, drives: Sequence[Drive], base: Drive, unit: str
) -> None:
    """Plot by how much controls differ from those of a drive, step by step.

    Random looks appear as the range over their runs and its mean.

    Args:
        path: PNG file.
        drives: of as many steps as `base`.
        base: the drive of the case `own`.
        unit: of the control.
    """
    with chart(path, 3.0) as figure:
        axis = figure.subplots()
        changes = {
            case: np.array(
                [d.controls - base.controls for d in drives if d.case == case]
            )
            for case in CASES
        }
        random = changes[RANDOM]
        if len(random):
            band = {"facecolor": _STYLES[RANDOM]["color"], "alpha": 0.25}
            axis.fill_between(base.time_s, random.min(0), random.max(0), **band)
            style = _style(RANDOM, linewidth=1.6, label="random: range, mean")
            axis.plot(base.time_s, random.mean(0), **style)
        for case in (NO_OBJECT, BEST_RANDOM, ATTACK):
            for row in changes[case]:
                axis.plot(base.time_s, row, **_style(case, label=_LABELS[case]))
        axis.axhline(0, color=_STYLES[OWN]["color"], label=_LABELS[OWN])
        axis.set_title(f"Change of control: {base.environment}", loc="left")
        axis.set_xlabel("time (s)")
        axis.set_ylabel(f"change of control ({unit})")
        axis.grid(alpha=0.25)
        figure.legend(loc="outside lower center", ncols=5, frameon=False)


def _environments(drives: Sequence[Drive]) -> dict[str, list[Drive]]:
    names = sorted({drive.environment for drive in drives}, key=environment_order)
    return {name: [d for d in drives if d.environment == name] for name in names}


def _cases(drives: Sequence[Drive]) -> list[str]:
    present = {drive.case for drive in drives}
    return [case for case in CASES if case in present]


def _style(case: str, **changes: Any) -> dict[str, Any]:
    return {**_STYLES[case], **changes}


def _drawing_order(drive: Drive) -> float:
    return _STYLES[drive.case]["zorder"]


def _view(
    drives: Sequence[Drive], objects: Sequence[np.ndarray], lane_width_m: float
) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([*(d.states[:, :2] for d in drives), *objects])
    margin = max(0.75 * lane_width_m, 1.0)
    return points.min(axis=0) - margin, points.max(axis=0) + margin


def _map_panels(count: int, low: np.ndarray, high: np.ndarray) -> tuple[Figure, Any]:
    """Place panels above each other where the map is wide, else beside each other."""
    width_in = WIDTH_PX / DPI
    aspect = float((high[1] - low[1]) / (high[0] - low[0]))
    rows = count if aspect < 0.6 else 1
    columns = count // rows
    panel_in = (width_in - 0.7 * columns) / columns * aspect
    height_in = min(rows * (max(panel_in, 1.0) + 0.65) + 0.6, 14.0)
    figure = Figure((width_in, height_in), DPI, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def draw_lane(axis: Axes, route: np.ndarray, lane_width_m: float) -> None:
    """Draw a lane from above, its borders and its centre (n, 2), metres."""
    left, right = _borders(route, lane_width_m)
    axis.fill(*np.concatenate([left, right[::-1]]).T, facecolor=_LANE, zorder=0)
    for edge in (left, right):
        axis.plot(*edge.T, color="#b5b5b5", linewidth=0.8, zorder=1)
    axis.plot(*route.T, color=_CENTRE, linewidth=1, linestyle="--", zorder=2)


def _borders(route: np.ndarray, lane_width_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the left and the right border of a lane, (n, 2) each."""
    tangent = np.gradient(route, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    offset = lane_width_m / 2 * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    return route + offset, route - offset


def _cross(case: str) -> dict[str, Any]:
    style = {"linestyle": "none", "marker": "x", "markersize": 4.5, "zorder": 7}
    return style | {"color": _DARK[case], "markeredgewidth": 1.2}


def _map_handles(drives: Sequence[Drive], objects: bool, limit: float) -> list[Any]:
    lines = [
        Line2D([], [], label=_LABELS[c], **_style(c, linewidth=2))
        for c in _cases(drives)
    ]
    centre = Line2D([], [], color=_CENTRE, linestyle="--", label="lane centre")
    handles = [
        *lines,
        centre,
        Patch(facecolor=_LANE, edgecolor="#b5b5b5", label="lane"),
    ]
    if objects:
        handles.append(Patch(facecolor=_OBJECT, edgecolor="black", label="object"))
    if any(np.any(drive.departed(limit)) for drive in drives):
        label = f"departed (> {limit:.2f} m)"
        handles.append(Line2D([], [], label=label, **_cross(ATTACK)))
    return handles


def _draw_band(axis: Axes, drives: Sequence[Drive]) -> None:
    if not drives:
        return
    longest = max(drives, key=lambda drive: len(drive.time_s))
    table = np.ma.masked_all((len(drives), len(longest.time_s)))
    for row, drive in zip(table, drives, strict=True):
        row[: len(drive.time_s)] = drive.distance_m
    axis.fill_between(
        longest.time_s,
        table.min(axis=0),
        table.max(axis=0),
        facecolor=_STYLES[RANDOM]["color"],
        alpha=0.25,
        linewidth=0,
        zorder=1,
    )
    axis.plot(longest.time_s, table.mean(axis=0), **_style(RANDOM, linewidth=1.6))


def _legend_below(figure: Figure, handles: list[Any]) -> None:
    columns = {3: 3, 5: 5, 6: 3, 9: 5, 10: 5}.get(len(handles), 4)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, frameon=False
    )
