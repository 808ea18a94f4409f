"""Pictures of views next to each other: wanted, shown, how far apart, and depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from mi_nerfattack.evaluation.field_and_scene import RouteComparison
from mi_nerfattack.fit.scores import Pictures, ViewScore
from mi_nerfattack.report.plots.charts import DPI, PALETTE, WIDTH_PX, chart

_ERROR_MAX = 0.4  # of sRGB values, at the end of the scale
_FAR = 0.98  # quantile of depths at the end of the scale
_DEPTHS, _ERRORS, _NOTHING = "viridis_r", "inferno", "#c8c8c8"


def write_colours(
    path: str | Path, views: Sequence[ViewScore], reference: str, shown: str = "field"
) -> None:
    """Write image, field and error of views below each other.

    Args:
        path: PNG file.
        views: at least one, with their pictures, all of one size.
        reference: title of the column of images.
        shown: of the field's.
    """
    scale, pictures = Normalize(0, _ERROR_MAX), _pictures(views)
    with chart(path, _height(pictures, 3)) as figure:
        rows = _panels(figure, views, (reference, shown, "difference"))
        for pair, axes in zip(pictures, rows, strict=True):
            error = np.abs(pair.shown.image - pair.expected).mean(axis=2)
            axes[0].imshow(np.clip(pair.expected, 0, 1), interpolation="nearest")
            axes[1].imshow(np.clip(pair.shown.image, 0, 1), interpolation="nearest")
            _map(axes[2], error, _ERRORS, scale=scale)
        label = "difference of sRGB values (0 to 1), mean of the channels"
        _bar(figure, rows, _ERRORS, scale=scale, label=label)


def write_depths(
    path: str | Path,
    views: Sequence[ViewScore],
    unit: str = "m",
    titles: tuple[str, str] = ("field", "known"),
) -> None:
    """Write the field's depth of views below each other, next to the known depth.

    Grey is where the field stops less than half of the light, or nothing is known.

    Args:
        path: PNG file.
        views: at least one, with their pictures, all of one size.
        unit: of the depths, for the labels.
        titles: of the columns with the field's depth and with the known depth.
    """
    pictures = _pictures(views)
    shown = [pair.shown.solid_depth for pair in pictures]
    known_depths = [pair.depth for pair in pictures if pair.depth is not None]
    known = len(known_depths) == len(shown)
    low, high = _range([*shown, *known_depths])
    scale = Normalize(low, high)
    columns = (*titles, "difference") if known else titles[:1]
    errors = [abs_difference(*pair) for pair in zip(shown, known_depths, strict=False)]
    error_scale = Normalize(0, _top(errors))
    with chart(path, _height(pictures, 3 if known else 2)) as figure:
        rows = _panels(figure, views, columns)
        for i, axes in enumerate(rows):
            _map(axes[0], shown[i], _DEPTHS, scale=scale)
            if known:
                _map(axes[1], known_depths[i], _DEPTHS, scale=scale)
                _map(axes[2], errors[i], _ERRORS, scale=error_scale)
        _bar(figure, rows, _DEPTHS, scale=scale, label=f"depth along the ray ({unit})")
        if known:
            _bar(
                figure,
                rows,
                _ERRORS,
                scale=error_scale,
                label=f"difference of depths ({unit})",
            )


#: Below each other: label, factor, figures with their dashes, and what they are.
_ALONG = (
    ("PSNR (dB)", 1.0, {"psnr_db": "-"}, ""),
    ("SSIM", 1.0, {"ssim": "-"}, ""),
    (
        "depth error (m)",
        1.0,
        {"depth_median_m": "-", "depth_p90_m": "--"},
        "solid: median; dashed: 90 % of the near rays",
    ),
    (
        "rays (%)",
        100.0,
        {"wrong": "-", "hazy": "--"},
        "solid: wrong opacity; dashed: hazy",
    ),
)


def write_along(
    path: str | Path, routes: Sequence[RouteComparison], limits: Mapping[str, float]
) -> None:
    """Plot PSNR, SSIM, depth error and wrong opacity against the arc length.

    Args:
        path: PNG file.
        routes: a colour each.
        limits: by figure; dotted.
    """
    with chart(path, 7.2) as figure:
        axes = figure.subplots(len(_ALONG), 1, sharex=True)
        for axis, (label, factor, dashes, note) in zip(axes, _ALONG, strict=True):
            for name, dash in dashes.items():
                for route, colour in zip(routes, cycle(PALETTE), strict=False):
                    arc = [station.arc_m for station in route.stations]
                    values = [factor * getattr(at, name) for at in route.stations]
                    style = {"color": colour, "linewidth": 1.6, "linestyle": dash}
                    axis.plot(arc, values, label=route.name, **style)
                if name in limits:
                    axis.axhline(
                        limits[name], color="black", linewidth=1, linestyle=":"
                    )
            if note:
                axis.set_ylim(bottom=0)
                axis.set_title(note, loc="right", fontsize=8, color="#555555")
            axis.set_ylabel(label)
            axis.grid(alpha=0.25)
        axes[-1].set_xlabel("arc length (m)")
        figure.align_ylabels()
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=6)


def abs_difference(shown: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return |shown - known|, infinite where either is; no value is NaN."""
    both = np.isfinite(shown) & np.isfinite(known)
    result = np.full(np.shape(known), np.inf)
    result[both] = np.abs(shown[both].astype(np.float64) - known[both])
    return result


def _map(axis: Axes, values: np.ndarray, name: str, scale: Normalize) -> None:
    colours = matplotlib.colormaps[name].with_extremes(bad=_NOTHING)
    masked = np.ma.masked_where(~np.isfinite(values), values)
    axis.imshow(masked, cmap=colours, norm=scale, interpolation="nearest")


def _range(maps: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the least and nearly the greatest finite value; 0 and 1 if none is."""
    values = np.concatenate([values[np.isfinite(values)] for values in maps])
    if values.size == 0:
        return 0.0, 1.0
    low, high = float(values.min()), float(np.quantile(values, _FAR))
    return low, max(high, low + 1e-3)


def _top(maps: Sequence[np.ndarray]) -> float:
    """Return twice the 0.9 quantile of finite values, at least a centimetre."""
    finite = [values[np.isfinite(values)] for values in maps]
    if not any(values.size for values in finite):
        return 1.0
    return max(0.01, 2 * float(np.quantile(np.concatenate(finite), 0.9)))


def _pictures(views: Sequence[ViewScore]) -> list[Pictures]:
    return [view.pictures for view in views if view.pictures is not None]


def _height(pictures: Sequence[Pictures], columns: int) -> float:
    height, width = pictures[0].shown.depth.shape
    row = WIDTH_PX / DPI / columns * height / width + 0.28
    return len(pictures) * row + 1.1


def _panels(
    figure: Figure, views: Sequence[ViewScore], columns: Sequence[str]
) -> np.ndarray:
    grid = figure.subplots(len(views), len(columns), squeeze=False)
    for view, axes in zip(views, grid, strict=True):
        for axis in axes:
            axis.set_axis_off()
        title = f"{view.name}: {view.psnr_db:.2f} dB, SSIM {view.ssim:.3f}"
        axes[0].set_title(title, fontsize=8)
    for axis, name in zip(grid[0], columns, strict=True):
        before = axis.get_title(loc="left")
        axis.set_title(f"{name}\n{before}", fontsize=8)
    return grid


def _bar(
    figure: Figure, rows: np.ndarray, name: str, scale: Normalize, label: str
) -> None:
    figure.colorbar(
        ScalarMappable(scale, name),
        ax=rows.ravel().tolist(),
        location="bottom",
        label=label,
        extend="max",
        shrink=0.6,
        aspect=50,
        pad=0.02,
    )
