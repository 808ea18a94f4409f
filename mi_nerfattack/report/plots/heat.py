"""Where on an object a failure is made: its texture's gradient as heat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.report.plots.charts import DPI, WIDTH_PX, chart
from mi_nerfattack.report.plots.strip import PAPER, Around, over_paper

#: Sides of the object, by the compass of its own frame: degrees about z from +x.
SIDES = {"from +x": 0.0, "from +y": 90.0, "from -x": 180.0, "from -y": 270.0}
#: Opacity below which a pixel counts as beside the object.
VISIBLE = 0.1
_ROWS = ("as it looks", "sensitivity")  # of an object
_BAR_IN = 0.8  # of the colour bar with its label
COLOUR_MAP = "viridis"  # perceptually uniform
#: The finest level that is shown has at most so many vertices along an edge: finer
#: ones show which rays were traced rather than where the object matters.
MAX_RESOLUTION = 28


class MagnitudeField(AbstractField):
    """A grid field's geometry, with numbers at its vertices instead of colours.

    Not differentiable.

    Args:
        grid: gives bounds, occupancy and density.
        values: (n_vertices,) numbers at least 0 on one level and 0 on all others,
            which are interpolated.
    """

    kind = "magnitude_field"

    def __init__(self, grid: GridField, values: np.ndarray) -> None:
        self.grid = grid
        self.lower, self.upper = grid.lower, grid.upper
        self.step_m, self.cone = grid.step_m, grid.cone
        self.occupancy, self.window = grid.occupancy, grid.window
        table = np.repeat(np.asarray(values, np.float32)[:, None], 3, axis=1)
        density = grid.parameters()["density"].numpy().copy()
        self.values = GridField(
            grid.layout,
            grid.lower,
            grid.upper,
            density=density,
            texture=table,
            occupancy=grid.occupancy,
            density_scale=grid.density_scale,
            step_m=grid.step_m,
        )

    def eval_everywhere(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """Evaluate density and, as a grey radiance, the interpolated number."""
        density = self.grid.density_everywhere(point, active)
        unit = dr.clip(self.unit(point), 0.0, 1.0 - 1e-6)
        features = self.values.encoding(unit, active)
        levels = range(1, self.grid.layout.levels)
        number = sum((features[4 * level + 1] for level in levels), start=features[1])
        return density, mi.Color3f(number) & active

    def arrays(self) -> list[Any]:
        """Return what both grids read."""
        return [*self.grid.arrays(), self.values.packed]


@dataclass(frozen=True, eq=False)
class SideView:
    """An object from one side.

    Attributes:
        name: of the side.
        colour: (height, width, 3), sRGB in [0, 1], over white.
        heat: (height, width), gradient per volume, NaN outside of the object.
    """

    name: str
    colour: np.ndarray
    heat: np.ndarray


def surface_heat(grid: GridField, gradient: np.ndarray) -> np.ndarray:
    """Turn a texture's gradient into numbers that one level's vertices hold.

    The gradient at a vertex adds up the contributions of the surface within a voxel
    around the vertex. So it is divided by the volume of that voxel. The level is the
    finest with at most `MAX_RESOLUTION` vertices along an edge.

    Args:
        grid: the object.
        gradient: (n_vertices, 3), derivative by the raw colours.

    Returns:
        (n_vertices,), Euclidean norm over colours, per cubic metre.
    """
    gradient = np.asarray(gradient, np.float64)
    level, resolution = _shown_level(grid)
    start = grid.encoding.level_offset(level)
    end = start + resolution**3
    voxel = np.prod((grid.upper - grid.lower) / (resolution - 1))
    values = np.zeros(grid.n_vertices)
    values[start:end] = np.linalg.norm(gradient[start:end], axis=1) / voxel
    return values


def side_views(
    grid: GridField, gradient: np.ndarray, edge_px: int = 320
) -> list[SideView]:
    """Render an object and its heat from four sides, a little from above.

    Args:
        grid: the object, with the texture that is to be seen.
        gradient: (n_vertices, 3), derivative by its texture.
        edge_px: longer edge of the views.
    """
    values = surface_heat(grid, gradient)
    largest = values.max() or 1.0  # keeps the march in a good range of numbers
    around = Around(grid.lower, grid.upper, list(SIDES.values()), edge_px=edge_px)
    heats = around.views(MagnitudeField(grid, values / largest))
    views = []
    for name, look, (heat, _) in zip(SIDES, around.views(grid), heats, strict=True):
        opacity = look[1]
        visible = opacity > VISIBLE
        shown = heat[..., 0] / np.where(visible, opacity, 1) * largest
        views.append(
            SideView(name, over_paper(*look), np.where(visible, shown, np.nan))
        )
    return views


def write_heat(
    path: str | Path, objects: Mapping[str, Sequence[SideView]], unit: str = "cost"
) -> None:
    """Write a picture with two rows per object and one column per side.

    The first row of an object shows its appearance, the second row shows its heat. The
    heat of all objects has one scale, from zero to the 99.5th percentile.

    Args:
        path: PNG file.
        objects: views by name of the object.
        unit: of the objective, for the colour bar.
    """
    heats = np.concatenate(
        [view.heat.ravel() for views in objects.values() for view in views]
    )
    known = heats[np.isfinite(heats)]
    top = float(np.percentile(known, 99.5)) if known.size else 0.0
    norm = Normalize(0.0, top or 1.0)
    rows = 2 * len(objects)
    with chart(path, _height_in(objects)) as figure:
        axes = figure.subplots(rows, len(SIDES), squeeze=False)
        for i, (name, views) in enumerate(objects.items()):
            axes[2 * i, 0].set_title(name, fontsize=9)
            for column, view in enumerate(views):
                _show(axes[2 * i, column], view.colour)
                _show(axes[2 * i + 1, column], _coloured(view, norm))
                axes[2 * i + 1, column].set_xlabel(view.name)
            for axis, label in zip(axes[2 * i :, 0], _ROWS, strict=False):
                axis.set_ylabel(label, rotation=0, ha="right", va="center")
        bar = figure.colorbar(
            ScalarMappable(norm, COLOUR_MAP),
            ax=axes.ravel().tolist(),
            extend="max",
            location="bottom",
            aspect=60,
        )
        bar.set_label(f"|d {unit} / d raw colour| per m³")


def _height_in(objects: Mapping[str, Sequence[SideView]]) -> float:
    """Return the height at which views fill their cells, inches."""
    cell_in = WIDTH_PX / DPI / (len(SIDES) + 0.4)
    aspects = [views[0].heat.shape for views in objects.values()]
    rows = sum(2 * height / width for height, width in aspects)
    return rows * cell_in + 0.6 * len(objects) + _BAR_IN


def _shown_level(grid: GridField) -> tuple[int, int]:
    """Return the level that is shown, and its vertices along an edge."""
    encoding: Any = grid.encoding
    best = (0, 0)
    for level in range(grid.layout.levels):
        resolution = int(encoding._resolution(encoding._level_scale(level)))
        if level == 0 or best[1] < resolution <= MAX_RESOLUTION:
            best = level, resolution
    return best


def _coloured(view: SideView, norm: Normalize) -> np.ndarray:
    """Colour a heat map by the colour map, white beside the object."""
    known = np.isfinite(view.heat)
    mapped = matplotlib.colormaps[COLOUR_MAP](norm(np.where(known, view.heat, 0)))
    return np.where(known[..., None], mapped[..., :3], PAPER)


def _show(axis: Axes, image: np.ndarray) -> None:
    axis.imshow(image, interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(False)
