"""The figure of a policy's page: errors over time, by route and environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from mi_nerfattack.report.plots.charts import BLUE, GREY, ORANGE, chart
from mi_nerfattack.rollout.drive import Drive

_STYLES: dict[str, dict[str, Any]] = {
    "random": {"color": ORANGE, "linewidth": 0.8, "linestyle": (0, (5, 1.2))},
    "no_object": {"color": BLUE, "linewidth": 0.9},
    "expert": {"color": GREY, "linewidth": 0.8, "linestyle": ":"},
}
_LABELS = {
    "no_object": "alone",
    "random": "past objects of random texture",
    "expert": "expert, alone",
}
_ROW_IN, _LEGEND_IN = 1.9, 0.5


def plot_errors(
    path: str | Path,
    drives: Mapping[tuple[str, str, str], Sequence[Drive]],
    limits: Mapping[str, float],
) -> None:
    """Plot the signed distance from the lane centre, a line a drive.

    Args:
        path: PNG file.
        drives: by environment, route and case.
        limits: departure limit of each route, metres; dotted.
    """
    environments = list(dict.fromkeys(key[0] for key in drives))
    routes = list(dict.fromkeys(key[1] for key in drives))
    with chart(path, _ROW_IN * len(routes) + _LEGEND_IN) as figure:
        grid = figure.subplots(
            len(routes), len(environments), sharex="row", sharey="row", squeeze=False
        )
        for row, route in zip(grid, routes, strict=True):
            for axis, environment in zip(row, environments, strict=True):
                for case in _STYLES:
                    _draw(axis, drives.get((environment, route, case), ()), case)
                for sign in (-1, 1):
                    limit = sign * limits[route]
                    axis.axhline(limit, color="black", linewidth=1, linestyle=":")
                axis.set_title(f"{route}, {environment}", loc="left", fontsize=9)
                axis.grid(alpha=0.25)
            row[0].set_ylabel("m to the left")
        for axis in grid[-1]:
            axis.set_xlabel("time (s)")
        figure.legend(handles=_handles(drives), loc="outside lower center", ncols=4)


def _draw(axis: Axes, drives: Sequence[Drive], case: str) -> None:
    for drive in drives:
        axis.plot(drive.time_s, drive.cross_track_m, alpha=0.8, **_STYLES[case])


def _handles(drives: Mapping[tuple[str, str, str], Any]) -> list[Line2D]:
    present = {key[2] for key in drives}
    handles = [
        Line2D([], [], label=label, **{**_STYLES[case], "linewidth": 2})
        for case, label in _LABELS.items()
        if case in present
    ]
    return [
        *handles,
        Line2D([], [], color="black", linestyle=":", label="lane's limit"),
    ]
