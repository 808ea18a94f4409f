"""Levels of a hash grid: their vertices, colours of these, the largest sum."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

_ROUNDING = (
    1e-3  # cells of a level, more than single precision errs by; files rely on it
)
_BATCH = 64  # blocks whose crossings are evaluated together


@dataclass(frozen=True)
class GridLevel:
    """One level of a grid field.

    Attributes:
        scale: its vertex i lies at i / scale along an edge of the unit cube.
        resolution: vertices along an edge.
        vertices: which of the field's they are, x the fastest.
    """

    scale: float
    resolution: int
    vertices: slice


def level_growth(levels: int, base: int, largest: int) -> float:
    """Return the factor between neighbouring levels that leads from base to largest."""
    return 1.0 if levels == 1 else float((largest / base) ** (1 / (levels - 1)))


def lay_out_levels(
    count: int, base: int, largest: int, features: int, most: int
) -> tuple[list[GridLevel], int]:
    """Return the levels of a `HashGridEncoding` without making one.

    Args:
        count: number of levels.
        base: vertices along an edge of the coarsest.
        largest: vertices along an edge of the finest.
        features: numbers per vertex; a level's size is a multiple of them.
        most: largest size of a level, vertices.

    Returns:
        the levels, the coarsest first, and how many vertices the encoding has.
    """
    growth = dr.log2(level_growth(count, base, largest))
    levels, start = [], 0
    for index in range(count):
        scale = dr.exp2(index * growth) * base - 1.0
        resolution = int(dr.ceil(scale)) + 1
        stop = start + min(resolution**3, most)
        levels.append(GridLevel(scale, resolution, slice(start, stop)))
        start += min(-(-(resolution**3) // features) * features, most)
    return levels, start


def colours_of(level: GridLevel, texture: mi.Float) -> mi.Float:
    """Return the colours (3 n,) of a level's n vertices in a texture, evaluated."""
    size = 3 * (level.vertices.stop - level.vertices.start)
    index = 3 * level.vertices.start + dr.arange(mi.UInt32, size)
    colours = dr.gather(mi.Float, texture, index)
    dr.eval(colours)
    return colours


def without(level: GridLevel, texture: mi.Float) -> mi.Float:
    """Return a texture (3 n_vertices,) with zeros for the vertices of a level."""
    return dr.select(is_of(level, dr.width(texture)), 0, texture)


def is_same_beside(level: GridLevel, texture: mi.Float, other: mi.Float) -> bool:
    """Tell whether two textures differ in the colours of one level at most.

    Args:
        level: of a grid.
        texture: (3 n_vertices,) raw colours.
        other: of the same or another size.
    """
    size = dr.width(texture)
    same_size = size == dr.width(other)
    return same_size and bool(dr.all(is_of(level, size) | (texture == other)))


def is_of(level: GridLevel, size: int) -> mi.Bool:
    """Tell which entries of a texture are of a level."""
    index = dr.arange(mi.UInt32, size)
    return (index >= 3 * level.vertices.start) & (index < 3 * level.vertices.stop)


def read_planes(level: GridLevel, cells: np.ndarray) -> Iterator[np.ndarray]:
    """Yield which vertices are read in any occupied cell, plane by plane.

    Args:
        level: one of a grid.
        cells: boolean (rx, ry, rz), the occupied ones.

    Yields:
        boolean (resolution, resolution), of y and x, for every z.
    """
    x, y, z = [_readers(level, count) for count in cells.shape]
    layers = cells.transpose(2, 1, 0)
    for first, stop in zip(*z, strict=True):
        layer = np.logical_or.reduce(layers[first:stop])
        yield any_of(any_of(layer.T, *x).T, *y)


def count_read(levels: Sequence[GridLevel], cells: np.ndarray) -> int:
    """Count the vertices that are read in any occupied cell (rx, ry, rz)."""
    planes = (plane for level in levels for plane in read_planes(level, cells))
    return sum(int(np.count_nonzero(plane)) for plane in planes)


def _readers(level: GridLevel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of `count` cells that reads each vertex, and the first after."""
    edges = np.arange(count + 1) / count * level.scale
    low, high = np.floor(edges[:-1] - _ROUNDING), np.floor(edges[1:] + _ROUNDING) + 1
    vertex = np.arange(level.resolution)
    return np.searchsorted(high, vertex, "left"), np.searchsorted(low, vertex, "right")


def any_of(cells: np.ndarray, first: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Tell whether any cell is set along axis 0, from rows (n,) to before rows (n,)."""
    before = np.zeros((len(cells) + 1, *cells.shape[1:]), np.int32)
    np.cumsum(cells, 0, out=before[1:])
    return before[stop] > before[first]


def largest_sum(
    levels: Sequence[GridLevel], values: np.ndarray, cells: np.ndarray
) -> float:
    """Return the largest sum of all levels' interpolations in occupied cells.

    Between the planes through the vertices of all levels the sum is trilinear, so it is
    largest where three of them cross. Cells are cut into blocks of about a cell of the
    finest level. The crossings of a block are tried only where a bound of the sum, the
    sum of bounds of the levels, exceeds what was found before.

    Args:
        levels: of a grid.
        values: (vertices,), of all levels.
        cells: boolean (rx, ry, rz), the occupied ones.

    Returns:
        the largest sum, exact except for rounding; minus infinity without such a cell.
    """
    finest = levels[-1].resolution - 1
    blocks = cells.T  # z first, as vertices lie
    for axis, count in enumerate(blocks.shape):
        blocks = np.repeat(blocks, -(-finest // count), axis)
    bounds = np.zeros(blocks.shape, np.float32)
    for level in levels:
        bounds += _bound_blocks(level, values, blocks.shape)
    places, bounds = np.argwhere(blocks), bounds[blocks]
    order = np.argsort(-bounds)
    crossings = {count: _crossings(levels, count) for count in set(blocks.shape)}
    largest = -np.inf
    for first in range(0, len(order), _BATCH):
        batch = order[first : first + _BATCH]
        if bounds[batch[0]] <= largest:
            break
        pairs = zip(blocks.shape, places[batch].T, strict=True)
        points = [crossings[count][place] for count, place in pairs]
        largest = max(largest, _largest_at(points, levels, values))
    return largest


def _bound_blocks(
    level: GridLevel, values: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Bound one level in each of (bz, by, bx) blocks by its edges and vertices."""
    grid = values[level.vertices].reshape((level.resolution,) * 3)
    for axis, count in enumerate(shape):
        edges = np.arange(count + 1) / count * level.scale
        at_edges = _interpolate(grid, edges, axis)
        lower = at_edges.take(range(count), axis)
        bound = np.maximum(lower, at_edges.take(range(1, count + 1), axis))
        vertex, upper = np.floor(edges[:-1]) + 1, edges[1:]
        while (vertex < upper).any():  # a block without a further one repeats its edge
            inside = _interpolate(grid, np.minimum(vertex, upper), axis)
            np.maximum(bound, inside, out=bound)
            vertex += 1
        grid = bound
    return grid


def _interpolate(grid: np.ndarray, places: np.ndarray, axis: int) -> np.ndarray:
    """Interpolate along an axis at places (n,), in units of the vertices' distance."""
    low = np.minimum(places.astype(int), grid.shape[axis] - 2)
    weight = np.moveaxis((places - low).astype(np.float32)[:, None, None], 0, axis)
    lower, upper = grid.take(low, axis), grid.take(low + 1, axis)
    return lower + weight * (upper - lower)


def _crossings(levels: Sequence[GridLevel], count: int) -> np.ndarray:
    """Return where an edge of the unit cube crosses planes of vertices, block by block.

    Returns:
        (count, q), rising; each row from edge to edge of a block, the last repeated.
    """
    edges = np.arange(count + 1) / count
    planes = [np.arange(level.resolution) / level.scale for level in levels]
    places = np.unique(np.concatenate([edges, *planes]))
    first, last = (
        np.searchsorted(places, edges[:-1]),
        np.searchsorted(places, edges[1:]),
    )
    columns = np.arange((last - first).max() + 1)
    return places[np.minimum(first[:, None] + columns, last[:, None])]


def _largest_at(
    points: Sequence[np.ndarray], levels: Sequence[GridLevel], values: np.ndarray
) -> float:
    """Return the largest sum at the crossings of some blocks.

    Args:
        points: (m, q) of each block along z, y and x.
        levels: of a grid.
        values: (vertices,), of all levels.
    """
    total = np.zeros(1, np.float32)
    for level in levels:
        index, weights = [], []
        for place in points:
            scaled = place * level.scale
            low = scaled[:, :1].astype(int)
            width = int(np.ceil(scaled[:, -1:] - low).max()) + 1
            vertex = low + np.arange(width)
            hat = 1 - np.abs(scaled[..., None] - vertex[:, None])
            weights.append(np.maximum(hat, 0).astype(np.float32))
            index.append(np.minimum(vertex, level.resolution - 1))
        z, y, x = index
        grid = values[level.vertices].reshape((level.resolution,) * 3)
        block = grid[z[:, :, None, None], y[:, None, :, None], x[:, None, None, :]]
        for weight in reversed(weights):  # takes the last axis, puts points first
            m, first, second, vertices = block.shape
            rows = block.reshape(m, first * second, vertices)
            block = (weight @ rows.swapaxes(1, 2)).reshape(m, -1, first, second)
        total = total + block
    return float(total.max())
