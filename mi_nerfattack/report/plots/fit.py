"""Plots of a fit: where its views stood, how it went, how the held-out ones score."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.fit.options import FitProgress
from mi_nerfattack.fit.scores import ViewScore
from mi_nerfattack.report.plots.charts import BLUE, GREY, ORANGE, chart

_SMOOTH = 20  # points that a running mean spans, at most


def write_curve(
    path: str | Path, history: Sequence[FitProgress], heldout_db: float
) -> None:
    """Plot loss and PSNR of a fit against its steps and its time.

    Args:
        path: PNG file.
        history: reports in order; may be empty.
        heldout_db: mean PSNR of the held-out views at the end.
    """
    steps = [at.step for at in history]
    minutes = [at.elapsed_s / 60 for at in history]
    loss, psnr = [at.loss for at in history], [at.psnr_db for at in history]
    with chart(path, 4.6) as figure:
        grid = figure.subplots(2, 2, sharex="col", sharey="row")
        for axes, across in zip(grid.T, (steps, minutes), strict=True):
            for axis, values, colour in zip(
                axes, (loss, psnr), (ORANGE, BLUE), strict=True
            ):
                axis.plot(across, values, color=colour, linewidth=0.6, alpha=0.45)
                axis.plot(across, running_mean(values), color=colour, linewidth=1.8)
                axis.grid(alpha=0.25)
            if np.isfinite(heldout_db):
                axes[1].axhline(heldout_db, color=GREY, linestyle="--", zorder=1)
                text = f"held-out views at the end: {heldout_db:.2f} dB"
                axes[1].set_title(text, loc="right", fontsize=8, color="#555555")
            axes[1].xaxis.set_major_locator(MaxNLocator(6))
        if loss and min(loss) > 0:
            grid[0, 0].set_yscale("log")
        grid[0, 0].set_title("Rays that are fitted to")
        grid[0, 0].set_ylabel("loss")
        grid[1, 0].set_ylabel("PSNR (dB)")
        grid[1, 0].set_xlabel("step")
        grid[1, 1].set_xlabel("time (minutes)")
        figure.align_ylabels()


def write_cameras_above(
    path: str | Path, structure: Structure, flagged: AbstractSet[str]
) -> None:
    """Draw the path of cameras, where they look, and sparse points, from above.

    Args:
        path: PNG file.
        structure: with z up.
        flagged: names of images to take again.
    """
    eyes = structure.camera_to_world[:, :3, 3]
    ahead = structure.camera_to_world[:, :3, 2]
    reach = 0.04 * max(float(np.ptp(eyes[:, :2], axis=0).max()), 1e-9)
    bad = np.array([name in flagged for name in structure.names])
    with chart(path, 5.0) as figure:
        axes = figure.subplots()
        low, high = np.percentile(
            np.concatenate([structure.points, eyes]), [2, 98], axis=0
        )
        inside = ((structure.points >= low) & (structure.points <= high)).all(1)
        axes.scatter(*structure.points[inside, :2].T, s=0.4, color=GREY, alpha=0.4)
        axes.plot(*eyes[:, :2].T, color=BLUE, linewidth=0.8, alpha=0.6)
        for mask, colour, label in (
            (~bad, BLUE, f"cameras ({(~bad).sum()})"),
            (bad, ORANGE, f"take again ({bad.sum()})"),
        ):
            axes.scatter(*eyes[mask, :2].T, s=14, color=colour, label=label, zorder=3)
            ends = eyes[mask] + reach * ahead[mask]
            lines = np.stack([eyes[mask, :2], ends[:, :2]], axis=1)
            axes.plot(*lines.transpose(2, 1, 0), color=colour, linewidth=1.4)
        axes.set_aspect("equal")
        axes.set_xlabel("x")
        axes.set_ylabel("y")
        axes.legend(fontsize=8)
        axes.set_title("Cameras from above")


def write_histogram(path: str | Path, scores: Sequence[ViewScore]) -> None:
    """Plot how many held-out views have which PSNR.

    Args:
        path: PNG file.
        scores: of the held-out views; those of infinite PSNR are left out.
    """
    values = [score.psnr_db for score in scores if np.isfinite(score.psnr_db)]
    with chart(path, 2.6) as figure:
        axis = figure.subplots()
        if values:
            low, high = np.floor(min(values)), np.floor(max(values)) + 1
            width = max(0.5, np.ceil((high - low) / 30))
            bins = np.arange(low, high + width, width).tolist()
            axis.hist(values, bins, color=BLUE, rwidth=0.9)
            axis.axvline(float(np.mean(values)), color=ORANGE, linestyle="--")
            label = f"mean {np.mean(values):.2f} dB"
            axis.set_title(label, loc="right", fontsize=8, color=ORANGE)
        axis.set_title("Held-out views")
        axis.set_xlabel("PSNR (dB)")
        axis.set_ylabel("views")
        axis.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        axis.grid(alpha=0.25, axis="y")


def running_mean(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Average each value with those around it, fewer at both ends; same length."""
    data = np.asarray(values, np.float64)
    reach = min(_SMOOTH // 2, len(data) // 8)
    total = np.concatenate([[0.0], np.cumsum(data)])
    index = np.arange(len(data))
    low, high = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(data))
    return (total[high] - total[low]) / (high - low)
