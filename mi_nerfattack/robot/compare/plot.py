"""Real drives beside those of a run, as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mi_nerfattack.report.plots.charts import BLUE, GREEN, GREY, ORANGE, chart
from mi_nerfattack.robot.compare.aligned import Aligned, mean_of
from mi_nerfattack.robot.compare.course import Course
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, OWN, RANDOM

_COLOURS = {NO_OBJECT: GREEN, OWN: BLUE, RANDOM: GREY, ATTACK: ORANGE}


def plot_aligned(
    path: Path, aligned: Sequence[Aligned], course: Course, environment: str
) -> None:
    """Plot error, control and the change of control along the route.

    The run's drives are the range over them and, dashed, its mean; real ones a line
    each.

    Args:
        path: PNG file.
        aligned: at least one.
        course: of all.
        environment: of the run's drives.
    """
    changed = [item for item in aligned if item.real_change is not None]
    limit, unit = course.lane.wheel_m, course.control_unit
    with chart(path, 2.2 * (2 + bool(changed)) + 0.5) as figure:
        rows = figure.subplots(2 + bool(changed), 1, sharex=True, squeeze=False)[:, 0]
        longest: dict[str, Aligned] = {}  # of the run's drives, by case
        for item in sorted(aligned, key=lambda item: len(item.places)):
            longest[item.recorded.drive.case] = item
        for case, item in longest.items():
            _draw_run(rows[0], item.places, item.run.cross_track_m, _COLOURS[case])
            _draw_run(rows[1], item.places, item.run.control, _COLOURS[case])
        for item in aligned:
            style = {"color": _COLOURS[item.recorded.drive.case], "linewidth": 1.4}
            rows[0].plot(item.places, item.real.cross_track_m[0], **style)
            rows[1].plot(item.places, item.real.control[0], **style)
        for item in changed:
            style = {"color": _COLOURS[item.recorded.drive.case]}
            for values, dash in ((item.run_change, "--"), (item.real_change, "-")):
                rows[2].plot(item.places, values, linestyle=dash, **style)
            rows[2].set_ylabel(f"change of control ({unit})")
        for side in (-limit, limit):
            rows[0].axhline(side, color="black", linewidth=1, linestyle=":")
        rows[0].set_ylabel("cross-track error (m)")
        rows[1].set_ylabel(f"control as driven ({unit})")
        rows[-1].set_xlabel(f"arc length of route {course.route.name} (m)")
        for axis in rows:
            axis.grid(alpha=0.25)
        handles = [
            Line2D([], [], color=_COLOURS[case], label=case.replace("_", " "))
            for case in _COLOURS
            if case in longest
        ]
        handles += [
            Line2D([], [], color="black", label="real"),
            Line2D([], [], color="black", linestyle="--", label=f"{environment}, mean"),
            Patch(facecolor=GREY, alpha=0.25, label=f"{environment}, range"),
            Line2D([], [], color="black", linestyle=":", label="departure limit"),
        ]
        figure.legend(
            handles=handles, loc="outside lower center", ncols=4, frameon=False
        )


def _draw_run(axis: Axes, places: np.ndarray, run: np.ndarray, colour: str) -> None:
    low, high = np.nanmin(run, axis=0), np.nanmax(run, axis=0)
    axis.fill_between(places, low, high, facecolor=colour, alpha=0.2, linewidth=0)
    axis.plot(places, mean_of(run), color=colour, linewidth=1.2, linestyle="--")
