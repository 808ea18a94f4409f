"""Where a field is empty: for skipping space, and as a factor of its density."""

from __future__ import annotations

from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.errors import InputError

MAX_DISTANCE = 255


class Occupancy:
    """Boolean grid over a unit box, stored as Chebyshev distances to occupied cells.

    A cell that holds ``n > 0`` is empty, and so are all cells closer than ``n`` to
    it: a ray may leave the whole block of ``2 n - 1`` cells in one jump. Cells that
    hold 0 are occupied.

    Of occupied cells, a march may skip single octants. Costs one byte a cell, or four
    with octants.

    Args:
        cells: boolean (rx, ry, rz), True where the field may have density.
        octants: (rx, ry, rz) bytes, bit 4 x + 2 y + z set where the octant at the lower
            (0) or upper (1) end of each axis is worth a sample; nothing counts outside
            `cells`. All octants are when left out.
    """

    def __init__(self, cells: np.ndarray, octants: np.ndarray | None = None) -> None:
        self.cells: np.ndarray = np.ascontiguousarray(cells, dtype=bool)
        if self.cells.ndim != 3 or min(self.cells.shape) < 1:
            raise ValueError(f"occupancy: shape {cells.shape}; expected (rx, ry, rz)")
        rx, ry, rz = self.cells.shape
        self.shape: tuple[int, int, int] = (rx, ry, rz)
        self.octants: np.ndarray | None = (
            None if octants is None else octants * self.cells
        )
        occupied = self.cells if self.octants is None else self.octants > 0
        if occupied.all():
            distance = np.zeros(self.shape, np.uint8)
        elif not occupied.any():
            distance = np.full(self.shape, MAX_DISTANCE, np.uint8)
        else:
            from scipy import ndimage  # slow to import

            far: Any = ndimage.distance_transform_cdt(~occupied, metric="chessboard")
            distance = np.minimum(far, MAX_DISTANCE).astype(np.uint8)
        if self.octants is None:
            words = np.pad(distance.ravel(), (0, -distance.size % 4)).view("<u4")
        else:
            words = distance | self.octants.astype(np.uint32) << 8
        #: What :meth:`query` reads: four distances, or one, and above it the octants.
        self.words: mi.UInt32 = upload(mi.UInt32, words)
        dr.make_opaque(self.words)

    @staticmethod
    def full(resolution: int = 1) -> Occupancy:
        """Return a grid in which every cell is occupied."""
        return Occupancy(np.ones((resolution,) * 3, bool))

    @property
    def fraction(self) -> float:
        """Share of the cells that are occupied, 0 to 1."""
        return float(self.cells.mean())

    @property
    def bounds(self) -> np.ndarray:
        """Smallest and largest corner of what is occupied, (2, 3), in the unit box.

        Raises:
            InputError: no cell is occupied.
        """
        if not self.cells.any():
            raise InputError("field: no cell is occupied; make the field again")
        sides = [self.cells.any(axis) for axis in ((1, 2), (0, 2), (0, 1))]
        extents = [np.flatnonzero(side)[[0, -1]] + [0, 1] for side in sides]
        return np.transpose(extents) / self.shape

    def query(self, unit: mi.Point3f, active: mi.Bool) -> tuple[mi.Float, mi.Point3f]:
        """Look up the distance grid.

        Args:
            unit: (3, n), positions in [0, 1]^3; outside is clamped to the border.
            active: (n,) mask.

        Returns:
            distance (n,) in cells, 0 where occupied, a half in an octant to be skipped
            of an occupied cell; and the cell's index (3, n).
        """
        rx, ry, rz = self.shape
        cell = mi.Point3f(
            dr.clip(dr.floor(unit.x * rx), 0, rx - 1),
            dr.clip(dr.floor(unit.y * ry), 0, ry - 1),
            dr.clip(dr.floor(unit.z * rz), 0, rz - 1),
        )
        index = (mi.UInt32(cell.x) * ry + mi.UInt32(cell.y)) * rz + mi.UInt32(cell.z)
        if self.octants is None:
            word = dr.gather(mi.UInt32, self.words, index >> 2, active)
            return mi.Float((word >> 8 * (index & 3)) & MAX_DISTANCE), cell
        word = dr.gather(mi.UInt32, self.words, index, active)
        distance, bits = mi.Float(word & MAX_DISTANCE), word >> 8
        for axis, weight in enumerate((4, 2, 1)):
            upper = unit[axis] * self.shape[axis] - cell[axis] >= 0.5
            bits >>= dr.select(upper, mi.UInt32(weight), 0)
        distance = dr.select((distance == 0) & (bits & 1 == 0), 0.5, distance)
        return distance, cell

    def exit(
        self,
        unit: mi.Point3f,
        direction: mi.Vector3f,
        cell: mi.Point3f,
        distance: mi.Float,
    ) -> mi.Float:
        """Return how far a ray goes before it leaves the empty block, (n,).

        Of an octant it returns less on most ways, as little as 0.

        Args:
            unit: (3, n), position in the unit box.
            direction: (3, n), of any length; the result is in units of it.
            cell: (3, n), from :meth:`query`.
            distance: (n,), from :meth:`query`, above 0.
        """
        result = mi.Float(dr.inf)
        for axis in range(3):
            forward = direction[axis] > 0
            edge = cell[axis] + dr.select(forward, distance, 1 - distance)
            step = edge / self.shape[axis] - unit[axis]
            moving = direction[axis] != 0
            t = step / dr.select(moving, direction[axis], 1)
            result = dr.minimum(result, dr.select(moving, t, dr.inf))
        return dr.maximum(result, 0)


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
