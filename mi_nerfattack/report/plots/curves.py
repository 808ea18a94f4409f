"""Plots of curves: what attacks found at what cost, and when a failure is made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from mi_nerfattack.errors import InputError
from mi_nerfattack.report.plots.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALETTE,
    PINK,
    SKY,
    YELLOW,
    chart,
)

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
                frames, best = curve["frames"], curve[name]
                axis.step(frames, best, where="post", color=BLUE, label="best so far")
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
            _draw(axis, curves, f"{method} ({len(curves)})", color=color, style=style)
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
        low, high = table.min(axis=0), table.max(axis=0)
        band = {"step": "post", "facecolor": color, "alpha": 0.18, "linewidth": 0}
        axis.fill_between(frames, low, high, **band)


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
            groups = [[y for x, y in points if x == position] for position in at]
            middle = np.array([np.median(group) for group in groups])
            ends = np.array([(min(group), max(group)) for group in groups]).T
            bars = np.abs(ends - middle)
            color = PALETTE[number % len(PALETTE)]
            axis.errorbar(
                at, middle, bars, capsize=3, label=name, color=color, marker="o"
            )
        _label(axis, "median and range of attacks", limit)
        figure.legend(loc="outside lower center", ncols=4, frameon=False)


#: Of objects: last the colours of the other lines.
_COLOURS = YELLOW, SKY, GREEN, PINK, BLUE, ORANGE


@dataclass(frozen=True, eq=False)
class TimeAttribution:
    """What each control period contributed to an objective's gradient.

    Attributes:
        time_s: (T,), seconds, at the end of each control period.
        costates: (T, n, m), minus the derivative of the objective by the states; the
            first three of the m rows are px, py (metres) and theta (radians).
        along: (T, k), inner products of the periods' texture gradients, object by
            object, with a direction: the gradient itself, or the change of texture
            that an attack made.
        cross_track_m: (T, n), metres, positive to the left.
        limit_m: departure limit, metres.
        objects: (k,) names.
    """

    time_s: np.ndarray
    costates: np.ndarray
    along: np.ndarray
    cross_track_m: np.ndarray
    limit_m: float
    objects: Sequence[str]

    def __post_init__(self) -> None:
        for name in ("costates", "along", "cross_track_m"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"{name}: not finite; check the gradient for NaN")

    @property
    def shares(self) -> np.ndarray:
        """Parts of the gradient that each period and object gave, (T, k); sum 1.

        ``<g_t, d> / sum_t <g_t, d>`` over periods and objects; negative where a period
        works against the others; zeros where the sum vanishes.
        """
        total = self.along.sum()
        return self.along / total if total else np.zeros_like(self.along)


def plot_attribution(
    path: str | Path, data: TimeAttribution, subject: str = "gradient"
) -> None:
    """Plot how sensitive the objective is and when its gradient is made, over time.

    Three panels have one time axis. The first shows the lengths of the costates: how a
    shift or a turn of the vehicle at that time would change the objective. The second
    shows the share of each control period in the texture's gradient, and the third the
    distance from the lane centre.

    Args:
        path: PNG file.
        data: of one drive, or of a batch: then one thin line per vehicle, and the mean.
        subject: what the shares are of.
    """
    with chart(path, 6.6) as figure:
        ratios = {"height_ratios": [1, 1, 1]}
        axes = figure.subplots(3, 1, sharex=True, gridspec_kw=ratios)
        _draw_costates(axes[0], data)
        _draw_shares(axes[1], data)
        _draw_errors(axes[2], data)
        axes[0].set_title("When the failure is made: sensitivity to the state")
        axes[1].set_title(f"Share of each control period in the {subject}")
        axes[2].set_title("Distance from the lane centre")
        axes[2].set_xlabel("time (s)")
        for axis in axes:
            axis.grid(alpha=0.25)
            axis.tick_params(labelbottom=True)
        axes[2].set_xlim(0, float(data.time_s[-1]))
        figure.align_ylabels()


def _draw_costates(axis: Axes, data: TimeAttribution) -> None:
    shift = np.linalg.norm(data.costates[..., :2], axis=-1)
    turn = np.abs(data.costates[..., 2])
    _draw_batch(axis, data, shift, colour=BLUE, label="shift, per metre", style="-")
    _draw_batch(
        axis, data, turn, colour=ORANGE, label="turn, per radian", style=(0, (5, 1.2))
    )
    axis.set_ylabel("|d cost / d state|")
    axis.set_ylim(bottom=0)
    _legend_above(axis)


def _draw_shares(axis: Axes, data: TimeAttribution) -> None:
    """Draw stacked bars, those against the others below the axis."""
    width = float(data.time_s[-1]) / len(data.time_s)
    shares = 100 * data.shares
    above, below = np.zeros(len(shares)), np.zeros(len(shares))
    for index, name in enumerate(data.objects):
        share = shares[:, index]
        bottom = np.where(share >= 0, above, below)
        axis.bar(
            data.time_s - width / 2,
            share,
            width,
            bottom,
            color=_COLOURS[index % len(_COLOURS)],
            edgecolor="white",
            linewidth=0.4,
            label=name,
            zorder=3,
        )
        above += np.maximum(share, 0)
        below += np.minimum(share, 0)
    axis.axhline(0, color="black", linewidth=0.8, zorder=4)
    axis.set_ylabel("share (%)")
    _legend_above(axis)


def _draw_errors(axis: Axes, data: TimeAttribution) -> None:
    _draw_batch(
        axis,
        data,
        np.abs(data.cross_track_m),
        colour=BLUE,
        label="mean over poses",
        style="-",
    )
    axis.axhline(data.limit_m, color="black", linewidth=1, linestyle=":")
    axis.annotate(
        f"departure limit {data.limit_m:.2f} m",
        (0.01, data.limit_m),
        xycoords=("axes fraction", "data"),
        xytext=(0, 2),
        textcoords="offset points",
        va="bottom",
    )
    top = max(1.2 * data.limit_m, 1.05 * float(np.abs(data.cross_track_m).max()))
    axis.set_ylim(0, top)
    axis.set_ylabel("|e| (m)")
    if data.cross_track_m.shape[1] > 1:
        axis.plot([], [], color=GREY, linewidth=0.8, label="single poses (thin lines)")
        _legend_above(axis)


def _draw_batch(
    axis: Axes,
    data: TimeAttribution,
    values: np.ndarray,
    colour: str,
    label: str,
    style: Any,
) -> None:
    """Draw a thin line for each vehicle of (T, n), and their mean."""
    if values.shape[1] > 1:
        thin = {"color": colour, "linewidth": 0.6, "alpha": 0.45}
        axis.plot(data.time_s, values, linestyle=style, **thin)
    mean = values.mean(axis=1)
    marker = "o" if len(mean) == 1 else ""
    thick = {"linewidth": 2.0, "linestyle": style, "marker": marker}
    axis.plot(data.time_s, mean, color=colour, label=label, clip_on=False, **thick)


def _legend_above(axis: Axes) -> None:
    """Put the legend beside the title, where it hides no data."""
    axis.legend(
        frameon=False,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
        ncols=4,
        borderpad=0.0,
    )
