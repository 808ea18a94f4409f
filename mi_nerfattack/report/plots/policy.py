"""The figure of a policy's page: errors over time, by route and environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.lines import Line2D

from mi_nerfattack.report.plots.charts import BLUE, GREY, ORANGE, chart
from mi_nerfattack.rollout.drive import NO_OBJECT, RANDOM, Drive

_STYLES: dict[str, dict[str, Any]] = {
    NO_OBJECT: {"color": BLUE, "linewidth": 0.9},
    "expert": {"color": GREY, "linewidth": 0.8, "linestyle": ":"},
}
_LABELS = {NO_OBJECT: "alone", "expert": "expert, alone"}
_PAST = {"color": ORANGE, "linewidth": 0.8, "linestyle": (0, (5, 1.2))}
#: Of further numbers of objects.
_COLORS = (ORANGE, "#882255", "#117733", "#AA4499")
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
                for case, style in _styles(drives).items():
                    for drive in drives.get((environment, route, case), ()):
                        error = drive.cross_track_m
                        axis.plot(drive.time_s, error, alpha=0.8, **style)
                for sign in (-1, 1):
                    limit = sign * limits[route]
                    axis.axhline(limit, color="black", linewidth=1, linestyle=":")
                axis.set_title(f"{route}, {environment}", loc="left", fontsize=9)
                axis.grid(alpha=0.25)
            row[0].set_ylabel("m to the left")
        for axis in grid[-1]:
            axis.set_xlabel("time (s)")
        figure.legend(handles=_handles(drives), loc="outside lower center", ncols=4)


def _styles(drives: Mapping[tuple[str, str, str], Any]) -> dict[str, dict[str, Any]]:
    """Return how the cases are drawn, those with objects below the others."""
    present = list(dict.fromkeys(key[2] for key in drives))
    past = [case for case in present if case not in _STYLES]
    styles = {
        case: {**_PAST, "color": color}
        for case, color in zip(past, cycle(_COLORS), strict=False)
    }
    return styles | {case: s for case, s in _STYLES.items() if case in present}


def _handles(drives: Mapping[tuple[str, str, str], Any]) -> list[Line2D]:
    handles = [
        Line2D([], [], label=_label(case), **{**style, "linewidth": 2})
        for case, style in _styles(drives).items()
    ]
    return [
        *handles,
        Line2D([], [], color="black", linestyle=":", label="lane's limit"),
    ]


def _label(case: str) -> str:
    count = case.removeprefix(f"{RANDOM}_")
    past = "an object" if count == RANDOM else f"{count} objects"
    return _LABELS.get(case, f"past {past} of random texture")
