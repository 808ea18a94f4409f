"""Draw the loop of a closed-loop attack, and the results of Table 2 by place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from PIL import Image

from mi_nerfattack.experiment.sweep.table import read_table
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, NO_OBJECT, RANDOM

TABLE = Path(__file__).parents[1] / "results/table2/results.csv"
LIMIT_M = 0.85  # beyond it a wheel is out of the lane: (3.5 m - 1.8 m) / 2
BLACK, BLUE, ORANGE, GREY = "#222222", "#0072B2", "#D55E00", "#666666"
# Text stays text, and a drawing that is made again is the same file.
STYLE = {"svg.fonttype": "none", "svg.hashsalt": "loop", "font.size": 11}
SIZE = np.array([1.9, 1.0])  # of a box
BOXES = {  # centre, text
    "object": (np.array([1.1, 1.6]), "object\ncolours"),
    "render": (np.array([4.1, 1.6]), "render\nMitsuba scene"),
    "policy": (np.array([7.1, 1.6]), "policy\nneural network"),
    "vehicle": (np.array([10.1, 1.6]), "vehicle\nmoves for 0.1 s"),
}
CASES = {  # label, marker, colour
    NO_OBJECT: ("no object", "_", BLACK),
    RANDOM: ("random textures", "o", BLUE),
    BEST_RANDOM: ("worst random texture", "^", BLUE),
    ATTACK: ("attack", "D", ORANGE),
}


def draw_loop(folder: Path, small: bool) -> None:
    """Draw render, policy and vehicle, and the gradient through all of them."""
    del small
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11.2, 3.2), facecolor="white")
        axis = figure.add_axes((0, 0, 1, 1))
        axis.set(xlim=(0, 11.2), ylim=(0, 3.2))
        axis.axis("off")
        for centre, text in BOXES.values():
            low = centre - SIZE / 2
            round_ = "round,pad=0,rounding_size=0.12"
            box = FancyBboxPatch((low[0], low[1]), *SIZE.tolist(), boxstyle=round_)
            box.set(facecolor="#EAF2F8", edgecolor=BLUE, linewidth=1.6)
            axis.add_patch(box)
            _label(axis, centre, text, BLACK, va="center")
        names = list(BOXES)
        for k, label in enumerate(("texture", "image", "steering")):
            start = BOXES[names[k]][0] + [SIZE[0] / 2, 0]
            end = BOXES[names[k + 1]][0] - [SIZE[0] / 2, 0]
            _arrow(axis, [start, end], BLACK)
            _label(axis, (start + end) / 2 + [0, 0.1], label, BLACK)
        _arrow(axis, _around("vehicle", "render", -1), BLACK)
        caption = "next frame: the camera sees the scene from the new pose"
        _label(axis, np.array([7.1, 0.2]), caption, BLACK)
        _arrow(axis, _around("vehicle", "object", 1), ORANGE, dashed=True)
        caption = "gradient of the distance from the lane centre, through every frame"
        _label(axis, np.array([5.6, 2.8]), caption, ORANGE)
        figure.savefig(folder / "loop.svg", metadata={"Date": None})


def draw_chart(folder: Path, small: bool) -> None:
    """Draw the mean distance from the lane centre of every drive in deployment."""
    path = folder / "chart.png"
    places_chart(read_table(TABLE)).savefig(path, dpi=40 if small else 100)
    with Image.open(path) as chart:  # a third of the size with 64 colours
        few = chart.convert("RGB").quantize(64, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def places_chart(table: pd.DataFrame) -> Figure:
    """Plot one mark per drive in deployment, by place, on a logarithmic axis.

    Args:
        table: of a sweep; a place is a route and a seed.
    """
    driven = table[table["environment"] == "mitsuba"]
    number = driven.groupby(["route", "seed"], sort=False).ngroup()
    places = list(driven[["route", "seed"]].drop_duplicates().itertuples(index=False))
    routes = dict.fromkeys(driven["route"])
    with matplotlib.rc_context({"font.size": 11}):
        figure = Figure(figsize=(9, 3.8), facecolor="white", layout="constrained")
        axis = figure.add_subplot()
        for case, (label, marker, colour) in CASES.items():
            own = driven["case"] == case
            x, y = number[own], driven.loc[own, "cross_track_mean_m"]
            style = {"s": 34, "color": colour, "marker": marker, "alpha": 0.75}
            axis.scatter(x, y, label=label, **style)
        axis.axhline(LIMIT_M, color=GREY, linestyle="--", linewidth=1)
        axis.text(
            -0.4,
            LIMIT_M * 1.15,
            "here a wheel is out of the lane",
            color=GREY,
            size=9.5,
        )
        for k in range(1, len(places)):
            if places[k][0] != places[k - 1][0]:
                axis.axvline(k - 0.5, color="#cccccc", linewidth=1)
        axis.set(yscale="log", xlim=(-0.6, len(places) - 0.4), yticks=[0.01, 0.1, 1])
        axis.set_yticklabels(["1 cm", "10 cm", "1 m"])
        axis.set_ylabel("mean distance from lane centre")
        middles = [
            np.mean([k for k, place in enumerate(places) if place[0] == route])
            for route in routes
        ]
        axis.set_xticks(middles, [f"{route}: 5 places" for route in routes])
        axis.tick_params(axis="x", length=0)
        figure.legend(loc="outside upper center", ncols=len(CASES), frameon=False)
    return figure


def _around(start: str, end: str, side: int) -> list[np.ndarray]:
    """Return the corners of a way above (1) or below (-1) the boxes."""
    first, last = (BOXES[name][0] + [0, side * SIZE[1] / 2] for name in (start, end))
    outside = [0, side * 0.5]
    return [first, first + outside, last + outside, last]


def _label(
    axis: Axes, place: np.ndarray, text: str, colour: str, va: str = "baseline"
) -> None:
    axis.text(place[0], place[1], text, ha="center", va=va, color=colour)


def _arrow(
    axis: Axes, points: Sequence[np.ndarray], colour: str, dashed: bool = False
) -> None:
    """Draw a line through points, with a head at its end."""
    line = {"color": colour, "linewidth": 1.8, "linestyle": "--" if dashed else "-"}
    if len(points) > 2:
        axis.plot(*np.transpose(points[:-1]), **line)
    head = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, "mutation_scale": 16}
    end, before = tuple(points[-1]), tuple(points[-2])
    axis.annotate("", end, before, arrowprops={**head, **line})
