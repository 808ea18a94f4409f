"""Plots of what attacks found, and at what cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from mi_nerfattack.report.plots.charts import BLUE, ORANGE, PALETTE, chart

#: `frames` rendered, increasing, and `cross_track_mean_m` of the best until then.
Curves = list[Mapping[str, Sequence[float]]]

_DASHES = ("-", "--", "-.", ":")


def convergence(
    path: str | Path,
    history: Sequence[Mapping[str, Any]],
    curve: Mapping[str, Sequence[float]] | None = None,
) -> None:
    """Plot an attack's objective, mean error and gains against its cost.

    Args:
        path: PNG file.
        history: one mapping per iteration with the keys `objective` and
            `cross_track_mean_m`; iterations count from 0. Of a gradient, `gain` and
            `predicted_gain`, too, None in tries.
        curve: `frames` and the same keys, of the best so far; of the first iterations,
            one after the other, and what came after them. None: drawn by iterations.
    """
    names = {"objective": "objective", "cross_track_mean_m": "mean distance (m)"}
    count = len(history)
    at = np.arange(count) if curve is None else np.array(curve["frames"][:count])
    marker = "o" if count < 60 else ""
    has_gains = any("gain" in entry for entry in history)
    with chart(path, 5.6 if has_gains else 4.2) as figure:
        axes = figure.subplots(2 + has_gains, 1, sharex=True)
        if has_gains:
            _draw_gains(axes[2], at, history)
        for axis, (name, label) in zip(axes[:2], names.items(), strict=True):
            values = [float(entry[name]) for entry in history]
            style = {"color": ORANGE, "marker": marker, "markersize": 3}
            axis.plot(at, values, label="of an iteration", **style)
            if curve is not None:
                best = curve["frames"], curve[name]
                axis.step(*best, where="post", color=BLUE, label="best so far")
            axis.set_ylabel(label)
            axis.grid(alpha=0.25)
            axis.xaxis.get_major_locator().set_params(integer=True)
        figure.axes[0].set_title(f"Attack of {count} iterations")
        figure.axes[0].legend(frameon=False)
        words = "iteration" if curve is None else "frames rendered, or their cost"
        figure.axes[-1].set_xlabel(words)
        figure.align_ylabels()


def _draw_gains(
    axis: Axes, at: np.ndarray, history: Sequence[Mapping[str, Any]]
) -> None:
    """Draw the gain that the gradient predicted of each iteration, and the real one."""
    for key, label, color in (
        ("predicted_gain", "predicted by the gradient", PALETTE[2]),
        ("gain", "real", ORANGE),
    ):
        axis.plot(
            at,
            np.array([entry[key] for entry in history], float),
            color=color,
            label=label,
        )
    axis.set_yscale("symlog", linthresh=0.1)
    axis.set_ylabel("gain")
    axis.grid(alpha=0.25)
    axis.legend(frameon=False, fontsize=8)


def damage(path: str | Path, methods: Mapping[str, Curves]) -> None:
    """Plot the mean distance from the lane centre against rendered frames.

    Of a method with several attacks, their median, and the range of them; as far as
    all of them have begun.

    Args:
        path: PNG file.
        methods: curves of attacks by method, at least one each.
    """
    with chart(path, 4.2) as figure:
        axis = figure.subplots()
        for number, (method, curves) in enumerate(methods.items()):
            color = PALETTE[number % len(PALETTE)]
            style = _DASHES[number // len(PALETTE) % len(_DASHES)]
            _draw(axis, curves, f"{method} ({len(curves)})", color, style)
        title = "best so far in the surrogate; median and range of so many attacks"
        _label(axis, title, "frames rendered, or their cost")
        figure.legend(loc="outside lower center", ncols=4, frameon=False)


def _label(axis: Axes, title: str, across: str) -> None:
    axis.set_ylim(bottom=0)
    axis.set_xlim(left=0)
    axis.set_xlabel(across)
    axis.set_ylabel("mean distance from\nthe lane centre (m)")
    axis.set_title(title, fontsize=9)
    axis.grid(alpha=0.25)


def _draw(axis: Axes, curves: Curves, label: str, color: str, style: str) -> None:
    begun = max(curve["frames"][0] for curve in curves)
    frames = np.unique(np.concatenate([curve["frames"] for curve in curves]))
    frames = frames[frames >= begun]
    table = np.stack([_held(curve, frames) for curve in curves])
    look = {"color": color, "linewidth": 1.6, "linestyle": style, "label": label}
    axis.step(frames, np.median(table, axis=0), where="post", **look)
    if len(curves) > 1:
        ends = table.min(axis=0), table.max(axis=0)
        band = {"step": "post", "facecolor": color, "alpha": 0.18, "linewidth": 0}
        axis.fill_between(frames, *ends, **band)


def _held(curve: Mapping[str, Sequence[float]], frames: np.ndarray) -> np.ndarray:
    """Return what had been found after so many frames."""
    done = np.searchsorted(curve["frames"], frames, side="right")
    return np.asarray(curve["cross_track_mean_m"])[done - 1]


def against_limit(
    path: str | Path,
    limit: str,
    environments: Mapping[str, Sequence[tuple[float, float]]],
) -> None:
    """Plot the mean distance from the lane centre against what textures may change.

    Of several attacks with one limit, their median, and the range of them.

    Args:
        path: PNG file.
        limit: what is limited, for the axis.
        environments: limit and distance of attacks by environment.
    """
    with chart(path, 3.6) as figure:
        axis = figure.subplots()
        for number, (name, points) in enumerate(environments.items()):
            at = sorted({x for x, _ in points})
            groups = [[y for x, y in points if x == here] for here in at]
            middle = np.array([np.median(group) for group in groups])
            ends = np.array([(min(group), max(group)) for group in groups]).T
            bars = np.abs(ends - middle)
            color = PALETTE[number % len(PALETTE)]
            axis.errorbar(
                at, middle, bars, capsize=3, label=name, color=color, marker="o"
            )
        _label(axis, "median and range of attacks", limit)
        figure.legend(loc="outside lower center", ncols=4, frameon=False)
