"""Emptiness as part of a field: a continuous factor of its density."""

from __future__ import annotations

from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.upload import upload

_SHARPNESS = 8.0

_TOUCHED = ((0, 1), (1,), (1, 2))  # padded neighbours of a vertex, along one axis


class Window:
    """Factor of a density: 0 in empty cells, 1 in occupied ones, continuous.

    A fit leaves any density in cells that it never compared with an image. The window
    makes emptiness a property of the field, the same for whatever evaluates it, and
    gives its boundary a slope, so that derivatives by position know of it.

    On the grid of half cells, a vertex has the value 0 if it touches an empty cell and
    1 otherwise. With V the trilinear interpolation, the factor is ``min(1, 8 V)^4``: it
    rises within a 16th of an occupied cell, and slowly enough for the opacity of a step
    through dense matter to follow. What lies outside the box is empty, but where no
    cell is empty the factor is 1 and density ends at the box at once.

    Costs four bytes a cell, and one of them is read at a point.

    Args:
        cells: boolean (rx, ry, rz), True where the field may have density.

    Attributes:
        cells: as given.
        is_open: whether no cell is empty.
    """

    def __init__(self, cells: np.ndarray) -> None:
        self.cells = cells
        self.is_open: bool = bool(cells.all())
        self._vertices = upload(mi.UInt32, _vertex_bits(cells, self.is_open))
        dr.make_opaque(self._vertices)

    @property
    def array(self) -> mi.UInt32:
        """What :meth:`__call__` reads, (rx ry rz,)."""
        return self._vertices

    def __call__(self, unit: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Return the factor, (n,); differentiable.

        Args:
            unit: (3, n), positions in the unit box; outside is clamped to it.
            active: (n,) mask.
        """
        _, ry, rz = self.cells.shape
        cell, half, between = [], [], []
        for value, count in zip(unit, self.cells.shape, strict=True):
            scaled = dr.clip(value, 0, 1) * count
            lower = dr.minimum(dr.floor(scaled), count - 1)
            twice = 2 * (scaled - lower)
            is_upper = twice >= 1
            cell.append(mi.UInt32(lower))
            half.append(dr.select(is_upper, mi.UInt32(1), 0))
            between.append(twice - dr.select(is_upper, 1.0, 0.0))
        index = (cell[0] * ry + cell[1]) * rz + cell[2]
        bits = dr.gather(mi.UInt32, self._vertices, index, active)
        bits >>= 9 * half[0] + 3 * half[1] + half[2]
        values = [
            dr.select((bits & (1 << (9 * i + 3 * j + k))) != 0, 1.0, 0.0)
            for i, j, k in product((0, 1), repeat=3)
        ]
        for weight in between:  # the first axis is the outermost in `values`
            middle = len(values) // 2
            pairs = zip(values[:middle], values[middle:], strict=True)
            values = [dr.lerp(low, high, weight) for low, high in pairs]
        return dr.square(dr.square(dr.minimum(1, _SHARPNESS * values[0])))


def _vertex_bits(cells: np.ndarray, outside: bool) -> np.ndarray:
    """Return the 27 vertices of each cell's halves as bits, uint32 (rx, ry, rz)."""
    rx, ry, rz = cells.shape
    padded = np.pad(cells, 1, constant_values=outside)
    bits = np.zeros(cells.shape, np.uint32)
    for vertex in product(range(3), repeat=3):
        full = np.ones(cells.shape, bool)
        for i, j, k in product(*(_TOUCHED[axis] for axis in vertex)):
            full &= padded[i : i + rx, j : j + ry, k : k + rz]
        x, y, z = vertex
        bit = np.uint32(1 << (9 * x + 3 * y + z))
        np.bitwise_or(bits, bit, out=bits, where=full)  # no copy of a large grid
    return bits
