"""Plots of drives over time, and how drives look in all plots.

Colours stay apart for colour-blind readers (after Okabe and Ito 2008) and are drawn
with different widths and dashes too. Figures are 1200 pixels wide.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mi_nerfattack.evaluation.metrics import environment_order
from mi_nerfattack.report.plots.charts import BLUE, GREY, ORANGE, chart
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
#: Of the expert, and of further numbers of objects of random texture.
_EXPERT: dict[str, Any] = {
    "color": BLUE,
    "linewidth": 1.0,
    "linestyle": ":",
    "zorder": 4.6,
}
_SEVERAL = ("#882255", "#117733", "#AA4499")
_DARK = {
    RANDOM: "#4d4d4d",
    NO_OBJECT: "#00523c",
    OWN: "#003f66",
    BEST_RANDOM: "#4a2a43",
    ATTACK: "#7a1f00",
}
_LIMIT: dict[str, Any] = {"color": "black", "linewidth": 1, "linestyle": ":"}
_BAND = {"facecolor": GREY, "alpha": 0.25, "linewidth": 0, "zorder": 1}

#: Drives by environment, route and case; "expert" and "random_6" are cases here, too.
NamedDrives = Mapping[tuple[str, str, str], Sequence[Drive]]


def by_name(drives: Sequence[Drive]) -> dict[tuple[str, str, str], list[Drive]]:
    """Group drives by environment, route and case."""
    groups: dict[tuple[str, str, str], list[Drive]] = {}
    for drive in sorted(drives, key=lambda drive: environment_order(drive.environment)):
        key = drive.environment, drive.route, drive.case
        groups.setdefault(key, []).append(drive)
    return groups


def errors(
    path: str | Path,
    drives: NamedDrives,
    limits: Mapping[str, float],
    signed: bool = False,
) -> None:
    """Plot the distance from the lane centre over time, by route and environment.

    Each drive is a line. Without signs, the drives past one object of random texture
    are the range over them and its mean, both at each time over those that last so
    long.

    Args:
        path: PNG file.
        drives: at least one.
        limits: departure limit of each route, metres.
        signed: distances to the left are positive, those to the right negative.
    """
    environments, routes, cases = (
        list(dict.fromkeys(key[i] for key in drives)) for i in range(3)
    )
    cases.sort(key=lambda case: line_style(case)["zorder"])
    height_in = 3.3 if len(routes) == 1 else 1.9 * len(routes) + 0.5
    with chart(path, height_in) as figure:
        grid = figure.subplots(
            len(routes), len(environments), sharex="row", sharey="row", squeeze=False
        )
        for row, route in zip(grid, routes, strict=True):
            for axis, environment in zip(row, environments, strict=True):
                for case in cases:
                    group = drives.get((environment, route, case), ())
                    _draw_errors(axis, case, group, signed=signed)
                label = f"departure limit {limits[route]:.2f} m"
                for limit in (limits[route], -limits[route])[: 1 + signed]:
                    axis.axhline(limit, **_LIMIT, label=label)
                axis.set_title(f"{route}: {environment}")
                axis.set_xlim(left=0)
                if not signed:
                    axis.set_ylim(bottom=0)
                axis.grid(alpha=0.25)
            row[0].set_ylabel("m to the left" if signed else "m from the lane centre")
        for axis in grid[-1]:
            axis.set_xlabel("time (s)")
        legend_below(figure, grid.ravel())


def _draw_errors(axis: Axes, case: str, drives: Sequence[Drive], signed: bool) -> None:
    if case == RANDOM and drives and not signed:
        longest = max(drives, key=lambda drive: len(drive.time_s))
        _draw_band(axis, longest.time_s, [drive.distance_m for drive in drives])
        return
    for drive in drives:
        error = drive.cross_track_m if signed else drive.distance_m
        axis.plot(drive.time_s, error, label=case_label(case), **line_style(case))


def control_change(
    path: str | Path, drives: Sequence[Drive], base: Drive, unit: str
) -> None:
    """Plot how much controls differ from the controls of a drive, step by step.

    Of several controls, the plot shows the first one, which steers. Random textures
    appear as the range over their runs and its mean.

    Args:
        path: PNG file.
        drives: of as many steps as `base`.
        base: the drive of the case `own`.
        unit: of the control.
    """
    own = base.first_controls
    with chart(path, 3.0) as figure:
        axis = figure.subplots()
        changes = {
            case: [d.first_controls - own for d in drives if d.case == case]
            for case in CASES
        }
        if changes[RANDOM]:
            _draw_band(axis, base.time_s, changes[RANDOM])
        for case in (NO_OBJECT, BEST_RANDOM, ATTACK):
            for row in changes[case]:
                axis.plot(base.time_s, row, label=case_label(case), **line_style(case))
        axis.axhline(0, color=_STYLES[OWN]["color"], label=case_label(OWN))
        axis.set_title(f"Change of control: {base.environment}")
        axis.set_xlabel("time (s)")
        axis.set_ylabel(f"change of control ({unit})")
        axis.grid(alpha=0.25)
        legend_below(figure, [axis])


def _draw_band(axis: Axes, time_s: np.ndarray, rows: Sequence[np.ndarray]) -> None:
    """Draw range and mean of rows past random textures, which may end early."""
    table = np.ma.masked_all((len(rows), len(time_s)))
    for line, row in zip(table, rows, strict=True):
        line[: len(row)] = row
    low, high = table.min(axis=0), table.max(axis=0)
    style: dict[str, Any] = {**line_style(RANDOM), "linewidth": 1.6}
    axis.plot(time_s, table.mean(axis=0), label="random, mean", **style)
    axis.fill_between(time_s, low, high, label="random, range", **_BAND)


def line_style(case: str) -> dict[str, Any]:
    """Return how the drives of a case are drawn."""
    several = case.removeprefix(f"{RANDOM}_")
    if several.isdecimal():
        return _STYLES[RANDOM] | {"color": _SEVERAL[int(several) % len(_SEVERAL)]}
    return {**_STYLES.get(case, _EXPERT)}


def case_label(case: str) -> str:
    """Return how a legend names a case."""
    return case.replace("_", " ")


def drawing_order(drive: Drive) -> float:
    """Return a key that sorts drives from below to above."""
    return _STYLES[drive.case]["zorder"]


def crosses(case: str) -> dict[str, Any]:
    """Return how the steps of a drive beyond the departure limit are marked."""
    style = {"linestyle": "none", "marker": "x", "markersize": 4.5, "zorder": 7}
    return style | {"color": _DARK[case], "markeredgewidth": 1.2}


def legend_below(figure: Figure, axes: Iterable[Axes]) -> None:
    """Put one legend of what axes have labels for below all of them."""
    labels: dict[str, Artist] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            labels.setdefault(label, handle)
    legend = figure.legend(
        labels.values(),
        labels.keys(),
        loc="outside lower center",
        ncols={3: 3, 5: 5, 6: 3, 9: 5, 10: 5}.get(len(labels), 4),
        frameon=False,
    )
    for line in legend.get_lines():
        line.set_linewidth(2)
