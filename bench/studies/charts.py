"""The charts of docs/results/findings; each function draws in an empty figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axis import Axis, XAxis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from mi_nerfattack.evaluation.summary import Interval
from mi_nerfattack.report.plots.charts import BLUE, GREY, PALETTE

DISTANCE = "mean distance from the lane centre (m)"
_MARKS = "_^Dosv"
_ABOVE: Any = {"loc": "outside upper center", "ncols": 6, "frameon": False}


def draw_places(figure: Figure, errors: pd.DataFrame) -> None:
    """Draw one mark per place (row) and case (column), metres, logarithmic."""
    axis = figure.subplots()
    colours = (GREY, *PALETTE)
    for number, case in enumerate(errors.columns):
        (marks,) = axis.plot(range(len(errors)), errors[case], _MARKS[number])
        marks.set(color=colours[number], label=case)
    axis.set_xticks(range(len(errors)), list(errors.index), rotation=45, ha="right")
    _make_logarithmic(axis.yaxis)
    axis.set_ylabel(DISTANCE)
    figure.legend(**_ABOVE)


def draw_searches(figure: Figure, errors: pd.DataFrame) -> None:
    """Draw one mark per search (row) and route (column), metres, logarithmic."""
    axis = figure.subplots()
    for route, colour in zip(errors.columns, PALETTE, strict=False):
        axis.plot(errors[route], range(len(errors)), "o", color=colour, label=route)
    _make_logarithmic(axis.xaxis)
    axis.set_xlabel(DISTANCE)
    _name_rows(figure, list(errors.index))
    figure.legend(**_ABOVE)


def draw_ratios(
    figure: Figure,
    ratios: Mapping[str, tuple[float, Interval]],
    label: str = "ratio of the mean errors, with its 95 % interval",
) -> None:
    """Draw a ratio with its interval per row, logarithmic; the line is at 1."""
    axis = figure.subplots()
    for row, (ratio, ends) in enumerate(ratios.values()):
        axis.plot(ends or [ratio] * 2, [row] * 2, color=BLUE, linewidth=2)
        axis.plot([ratio], [row], "o", color=BLUE)
    axis.axvline(1, color=GREY, linestyle="--")
    _make_logarithmic(axis.xaxis)
    axis.set_xlabel(label)
    _name_rows(figure, list(ratios))


def draw_shares(figure: Figure, shares: Mapping[str, float], label: str) -> None:
    """Draw one bar per name: a share of what the label says."""
    axis = figure.subplots()
    axis.barh(range(len(shares)), list(shares.values()), color=BLUE)
    for row, share in enumerate(shares.values()):
        axis.text(share + 0.01, row, f"{100 * share:.0f} %", va="center")
    axis.set_xlim(0, 1.1)
    axis.set_xlabel(label)
    _name_rows(figure, list(shares))


def draw_reach(figure: Figure, places: pd.DataFrame) -> None:
    """Draw the reach of each place, rad/s, logarithmic; full where the car goes out.

    Args:
        figure: empty.
        places: with the columns `kind`, `route`, `moved` and `out`.
    """
    axis, names = figure.subplots(), []
    for (kind, route), own in places.groupby(
        ["kind", "route"], observed=True, sort=False
    ):
        for is_out, marks in own.groupby("out"):
            (line,) = axis.plot(marks["moved"], [len(names)] * len(marks), "o")
            line.set(color=BLUE, fillstyle="full" if is_out else "none")
        name = str(kind).replace("_", " ")
        names.append(f"{name}, {route}: {own['out'].sum()} of {len(own)}")
    full, empty = (
        Line2D([], [], marker="o", linestyle="", color=BLUE, fillstyle=style)
        for style in ("full", "none")
    )
    labels = ["the car leaves its lane", "it stays in its lane"]
    _make_logarithmic(axis.xaxis)
    axis.set_xlabel("reach (rad/s), one mark per place")
    _name_rows(figure, names)
    figure.legend([full, empty], labels, **_ABOVE)


def draw_heat(figure: Figure, ratios: pd.DataFrame) -> None:
    """Draw ratios of environments (rows) and conditions; grey: nobody drove there."""
    axis = figure.subplots()
    image = axis.imshow(ratios, cmap="inferno", vmin=0, vmax=1.2, aspect="auto")
    axis.set_facecolor("#d9d9d9")
    for (row, column), value in np.ndenumerate(ratios.to_numpy()):
        if np.isfinite(value):
            colour = "black" if value > 0.7 else "white"
            style = {"ha": "center", "va": "center", "color": colour, "size": 7}
            axis.text(column, row, f"{value:.1f}", **style)
    ticks = range(ratios.shape[1])
    axis.set_xticks(ticks, list(ratios.columns), rotation=45, ha="right", size=7)
    axis.set_yticks(range(len(ratios)), list(ratios.index), size=7)
    figure.colorbar(image, ax=axis, label="error to the surrogate's by day")


def _make_logarithmic(axis: Axis) -> None:
    """Give an axis powers of ten with labels at 1, 2 and 5 times each of them."""
    (axis.axes.set_xscale if isinstance(axis, XAxis) else axis.axes.set_yscale)("log")
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _name_rows(figure: Figure, names: Sequence[str]) -> None:
    """Write names at the rows, the first one at the top."""
    (axis,) = figure.axes
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
