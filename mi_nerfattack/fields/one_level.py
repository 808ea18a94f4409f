"""The levels of a grid field, added up at the vertices of one lattice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.fields.levels import (
    GridLevel,
    any_of,
    colours_of,
    is_of,
    is_same_beside,
    without,
)

FEWEST = 96  # cells along an edge; a finest level of fewer is cut finer


class OneLevel:
    """Sums of all levels at the vertices of one lattice, and interpolated between them.

    The field interpolates each of its levels instead, so that the two differ between
    the vertices. The lattice is that of the finest level, cut into halves, thirds and
    so on until an edge has `FEWEST` cells. Vertices that no occupied cell reads are
    left out; values elsewhere mean nothing.

    Cost of a sample: 11 gathers, 8 of them of four numbers; all levels take 8 for each
    level. Memory: 4 bytes a cell of the whole lattice, 32 a cell that is read.

    Args:
        finest: the finest level.
        level: whose colours may change without all levels being added up again.
        cells: boolean (rx, ry, rz), where the field may have density.

    Attributes:
        level: whose colours may change.
        table: (4 v,) sums of raw density and colours, vertex by vertex; once `sum_up`
            has been called.
    """

    def __init__(self, finest: GridLevel, level: GridLevel, cells: np.ndarray) -> None:
        self.level = level
        scale = round(finest.scale)
        self._count: int = scale * -(-FEWEST // scale)
        blocks, corners, places = _lattice(cells, self._count)
        self._blocks = upload(mi.UInt32, blocks)
        self._corners = upload(mi.UInt32, corners)
        points = np.minimum(places / self._count, 1 - 1e-6)
        self._points = mi.Point3f(*(upload(mi.Float, axis) for axis in points.T))
        # Sums of the levels without the colours of `level`, and of which texture
        self._others, self._summed = mi.Float(0), mi.Float(0)
        self._table_texture = mi.Float(0)  # that `table` is of
        self.table = mi.Float(0)

    @property
    def lattice(self) -> list[Any]:
        """Which vertices each cell has."""
        return [self._blocks, self._corners]

    def sum_up(
        self,
        texture: mi.Float,
        sums: Callable[[mi.Point3f, mi.Float], list[mi.Float]],
    ) -> None:
        """Add the levels up; only the colours of `level`, if no others have changed.

        The table depends on the texture alone, not on those before.

        Args:
            texture: (3 n_vertices,) raw colours.
            sums: gives the four sums of all levels at points, with a texture.
        """
        with dr.suspend_grad():
            texture = mi.Float(dr.detach(texture))
            one, other = map(dr.detail.collect_indices, (texture, self._table_texture))
            if one == other:  # the same memory
                return
            if not is_same_beside(self.level, texture, self._summed):
                masked = without(self.level, texture)
                self._others = dr.ravel(mi.Vector4f(*sums(self._points, masked)))
                self._summed = texture
            colours = colours_of(self.level, texture)
            total = mi.Vector3f(0)
            for vertex, weight in self._corners_of_points():
                active = weight > 0
                part = dr.gather(mi.Vector3f, colours, vertex, active)
                total += dr.select(active, weight * part, 0)
            self.table = self._others + dr.ravel(mi.Vector4f(0, *total))
            dr.eval(self.table, self._others)
            self._table_texture = texture

    def eval(self, unit: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        """Return density, red, green and blue, raw, at points of the unit cube."""
        place = unit * self._count
        cell = dr.floor(place)
        x, y, z = (mi.UInt32(mi.Int32(value)) for value in dr.detach(cell))
        index = x + self._count * (y + self._count * z)
        block = dr.gather(mi.UInt32, self._blocks, index, active)
        lower = dr.gather(mi.Vector4u, self._corners, 2 * block, active)
        upper = dr.gather(mi.Vector4u, self._corners, 2 * block + 1, active)
        weights = _weights(place - cell)
        total = mi.Vector4f(0)
        for vertex, weight in zip([*lower, *upper], weights, strict=True):
            total += weight * dr.gather(mi.Vector4f, self.table, vertex, active)
        return list(total)

    def texture_gradient(self, by_table: mi.Float, n_vertices: int) -> mi.Float:
        """Return the gradient (3 n_vertices,) by the texture from that by `table`.

        It is known for the vertices of `level`, and NaN for all others.
        """
        with dr.suspend_grad():
            start, stop = self.level.vertices.start, self.level.vertices.stop
            gradient = dr.zeros(mi.Float, 3 * (stop - start))
            by_sums = dr.unravel(mi.Vector4f, by_table)
            for vertex, weight in self._corners_of_points():
                part = mi.Vector3f(by_sums.y, by_sums.z, by_sums.w) * weight
                dr.scatter_add(gradient, part, vertex, weight > 0)
            inside = is_of(self.level, 3 * n_vertices)
            index = dr.arange(mi.UInt32, 3 * n_vertices) - 3 * start
            own = dr.gather(mi.Float, gradient, index, inside)
            return dr.select(inside, own, dr.nan)

    def _corners_of_points(self) -> Iterator[tuple[mi.UInt32, mi.Float]]:
        """Yield which vertices of `level` the lattice's points lie between, and how."""
        side = self.level.resolution
        place = self._points * self.level.scale
        # A point that lies on a vertex except for rounding has this one alone
        nearest = dr.round(place)
        place = dr.select(dr.abs(place - nearest) < 1e-3, nearest, place)
        cell = dr.minimum(dr.floor(place), side - 2)
        first = mi.Vector3u(mi.Vector3i(cell))
        for k, weight in enumerate(_weights(place - cell)):
            x, y, z = first.x + (k & 1), first.y + (k >> 1 & 1), first.z + (k >> 2)
            yield x + side * (y + side * z), weight


def _weights(part: mi.Vector3f) -> list[mi.Float]:
    """Return the weights of a cell's corners, x the fastest, from a place in it."""
    x, y, z = [(1 - w, w) for w in part]
    return [x[k & 1] * (y[k >> 1 & 1] * z[k >> 2]) for k in range(8)]


def _lattice(
    occupied: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a box into cells, and keep those that have a part of an occupied one.

    Args:
        occupied: boolean (rx, ry, rz).
        count: cells along an edge.

    Returns:
        of each cell, x the fastest, which of the m kept ones it is, (count^3,); which
        of the v vertices these have, x the fastest, (m, 8); and where the vertices lie,
        from 0 to `count`, (v, 3).
    """
    mask = occupied
    for axis, size in enumerate(occupied.shape):
        edges = np.arange(count + 1) * size / count
        first = np.floor(edges[:-1] - 1e-3).clip(0, size - 1).astype(int)
        stop = np.floor(edges[1:] + 1e-3).clip(0, size - 1).astype(int) + 1
        rows = any_of(np.moveaxis(mask, axis, 0), first, stop)
        mask = np.moveaxis(rows, 0, axis)
    mask = mask.T  # z first, so that x is the fastest
    blocks = np.zeros(mask.shape, np.uint32)
    blocks[mask] = np.arange(np.count_nonzero(mask))
    cells = np.argwhere(mask).astype(np.int32)
    steps = [np.array([k >> 2, k >> 1 & 1, k & 1], np.int32) for k in range(8)]
    numbers = np.zeros((count + 1,) * 3, np.uint32)
    for step in steps:
        numbers[tuple((cells + step).T)] = 1
    vertices = np.argwhere(numbers)
    numbers[tuple(vertices.T)] = np.arange(len(vertices))
    corners = [numbers[tuple((cells + step).T)] for step in steps]
    return blocks.ravel(), np.stack(corners, 1), vertices[:, ::-1]
