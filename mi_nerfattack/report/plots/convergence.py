"""Plot of what an attack found, and at what cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mi_nerfattack.report.plots.charts import BLUE, ORANGE, chart


def convergence(
    path: str | Path,
    history: Sequence[Mapping[str, float]],
    curve: Mapping[str, Sequence[float]] | None = None,
) -> None:
    """Plot an attack's objective and mean cross-track error against its cost.

    Args:
        path: PNG file.
        history: one mapping per iteration with the keys `objective` and
            `cross_track_mean_m`; iterations count from 0.
        curve: `frames` and the same keys, of the best so far; of the first iterations,
            one after the other, and what came after them. None: drawn by iterations.
    """
    names = {"objective": "objective", "cross_track_mean_m": "mean distance (m)"}
    count = len(history)
    at = np.arange(count) if curve is None else np.array(curve["frames"][:count])
    marker = "o" if count < 60 else ""
    with chart(path, 4.2) as figure:
        for axis, (name, label) in zip(
            figure.subplots(2, 1, sharex=True), names.items(), strict=True
        ):
            values = [float(entry[name]) for entry in history]
            style = {"color": ORANGE, "marker": marker, "markersize": 3}
            axis.plot(at, values, label="of an iteration", **style)
            if curve is not None:
                best = curve["frames"], curve[name]
                axis.step(*best, where="post", color=BLUE, label="best so far")
            axis.set_ylabel(label)
            axis.grid(alpha=0.25)
            axis.xaxis.get_major_locator().set_params(integer=True)
        figure.axes[0].set_title(f"Attack of {count} iterations", loc="left")
        figure.axes[0].legend(frameon=False)
        words = "iteration" if curve is None else "frames rendered, or their cost"
        figure.axes[-1].set_xlabel(words)
        figure.align_ylabels()
