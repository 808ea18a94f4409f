"""Cells that a fit may fill, as far as depth maps tell."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def grid_shape(
    lower: np.ndarray, upper: np.ndarray, resolution: int
) -> tuple[int, int, int]:
    """Return the cells along each axis, `resolution` along the longest.

    No axis has fewer than half of that: in the flat box of a street the surfaces lie
    flat too, and a ray above the ground should meet few occupied cells.
    """
    extent = np.asarray(upper, float) - lower
    wanted = np.round(resolution * extent / extent.max())
    x, y, z = np.maximum((resolution + 1) // 2, wanted).astype(int)
    return int(x), int(y), int(z)


def cells_near_surfaces(
    points: Iterable[np.ndarray],
    lower: np.ndarray,
    upper: np.ndarray,
    shape: tuple[int, int, int],
) -> np.ndarray:
    """Mark the cells of a grid over a box that hold a point; boolean `shape`."""
    cells = np.zeros(shape, bool)
    for block in points:
        cell = np.floor((block - lower) / (upper - lower) * shape).astype(np.int64)
        inside = ((cell >= 0) & (cell < shape)).all(axis=1)
        cells[tuple(cell[inside].T)] = True
    return cells
