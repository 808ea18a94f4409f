"""Pictures of views beside each other: wanted, shown, how far apart, and depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from mi_nerfattack.fit.scores import SOLID
from mi_nerfattack.report.plots.charts import DPI, WIDTH_PX, chart

_ERROR_MAX = 0.4  # of sRGB values, at the end of the scale
_FAR = 0.98  # quantile of depths at the end of the scale
_DEPTHS, _ERRORS, _NOTHING = "viridis_r", "inferno", "#c8c8c8"


@dataclass(frozen=True, eq=False)
class ViewPair:
    """One view as it should be and as a field shows it.

    Attributes:
        title: one line.
        wanted: (height, width, 3), sRGB in [0, 1].
        shown: the field's, of the same shape.
        opacity: (height, width), the field's.
        depth: (height, width), metres along the ray, the field's.
        known_depth: (height, width), infinite where there is nothing; None if unknown.
    """

    title: str
    wanted: np.ndarray
    shown: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray
    known_depth: np.ndarray | None = None


def write_colours(
    path: str | Path, views: Sequence[ViewPair], wanted: str, shown: str = "field"
) -> None:
    """Write image, field and error of views below each other.

    Args:
        path: PNG file.
        views: at least one, all of one size.
        wanted: title of the column of images.
        shown: of the field's.
    """
    scale = Normalize(0, _ERROR_MAX)
    with chart(path, _height(views, 3)) as figure:
        rows = _panels(figure, views, (wanted, shown, "difference"))
        for view, axes in zip(views, rows, strict=True):
            error = np.abs(view.shown - view.wanted).mean(axis=2)
            axes[0].imshow(np.clip(view.wanted, 0, 1), interpolation="nearest")
            axes[1].imshow(np.clip(view.shown, 0, 1), interpolation="nearest")
            _map(axes[2], error, _ERRORS, scale)
        label = "difference of sRGB values (0 to 1), mean of the channels"
        _bar(figure, rows, _ERRORS, scale, label)


def write_depths(
    path: str | Path,
    views: Sequence[ViewPair],
    unit: str = "m",
    titles: tuple[str, str] = ("field", "known"),
) -> None:
    """Write the field's depth of views below each other, beside the known one.

    Grey is where the field stops less than half of the light, or nothing is known.

    Args:
        path: PNG file.
        views: at least one, all of one size.
        unit: of the depths, for the labels.
        titles: of the column of the field, and of that of what is known.
    """
    known = all(view.known_depth is not None for view in views)
    shown = [np.where(view.opacity >= SOLID, view.depth, np.inf) for view in views]
    given = [view.known_depth for view in views if view.known_depth is not None]
    scale = Normalize(*_range([*shown, *given]))
    columns = (*titles, "difference") if known else titles[:1]
    errors = [abs_difference(*pair) for pair in zip(shown, given, strict=False)]
    error_scale = Normalize(0, _top(errors))
    with chart(path, _height(views, 3 if known else 2)) as figure:
        rows = _panels(figure, views, columns)
        for i, axes in enumerate(rows):
            _map(axes[0], shown[i], _DEPTHS, scale)
            if known:
                _map(axes[1], given[i], _DEPTHS, scale)
                _map(axes[2], errors[i], _ERRORS, error_scale)
        _bar(figure, rows, _DEPTHS, scale, f"depth along the ray ({unit})")
        if known:
            _bar(figure, rows, _ERRORS, error_scale, f"difference of depths ({unit})")


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


def _height(views: Sequence[ViewPair], columns: int) -> float:
    height, width = views[0].depth.shape
    row = WIDTH_PX / DPI / columns * height / width + 0.28
    return len(views) * row + 1.1


def _panels(
    figure: Figure, views: Sequence[ViewPair], columns: Sequence[str]
) -> np.ndarray:
    grid = figure.subplots(len(views), len(columns), squeeze=False)
    for view, axes in zip(views, grid, strict=True):
        for axis in axes:
            axis.set_axis_off()
        axes[0].set_title(view.title, loc="left", fontsize=8)
    for axis, name in zip(grid[0], columns, strict=True):
        before = axis.get_title(loc="left")
        axis.set_title(f"{name}\n{before}", loc="left", fontsize=8)
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
