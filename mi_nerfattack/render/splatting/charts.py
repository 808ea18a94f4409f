"""Rays in charts: gathered by where they start, and sorted into cells by direction.

A chart is a pinhole view: a ray whose direction is (x, y, z) in the frame of the chart
stands at (x / z, y / z). Rays of one origin that keep within 66 degrees of their mean
direction share a chart; others are spread over the six faces of a cube around it. If
rays start on the near clips of cameras, each camera counts as one origin. Each chart is
cut into square cells of few rays, so that what may meet a ray is found cell by cell,
whatever the lens, the order of the rays and their number per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.rays import pick_rays

PER_CELL = 16  # rays, where cells are neither at their smallest nor at their largest
LEAST, LARGEST = 0.004, 0.015  # edge of a cell, tangent of an angle
ORIGINS = 64  # of the rays; with more of them, all rays share a chart
APART_M = 0.05  # between neighbours that are rays of two cameras, metres
NARROW = 0.4  # least cosine to the mean direction of rays that share a chart
_MARGIN = 1e-6  # around the rays of a chart
_SIGN = 1 << 31


@dataclass
class Charts:
    """c views, as kernels read them.

    Attributes:
        origin: (3, c).
        spread: (1,), metres that rays may start away from it.
        axes: right, up and ahead, (3, c) each.
        low: two (c,), the least coordinates of a ray.
        high: two (c,), the largest.
        size: (c,), edge of a cell.
        counts: two (c,), cells along the edges; 0 where there is no ray.
        first: (c,), the number of the first cell.
        rays: (c,), their number.
    """

    origin: mi.Point3f
    spread: mi.Float
    axes: list[mi.Vector3f]
    low: list[mi.Float]
    high: list[mi.Float]
    size: mi.Float
    counts: list[mi.UInt32]
    first: mi.UInt32
    rays: mi.UInt32

    def local(self, vector: mi.Vector3f) -> list[mi.Float]:
        """Return vectors (3, n) in the frames of n charts: right, up, ahead."""
        return [dr.dot(axis, vector) for axis in self.axes]

    def cell(self, column: mi.UInt32, row: mi.UInt32) -> mi.UInt32:
        """Return the number of a cell of n charts."""
        return self.first + row * self.counts[0] + column

    def middle(self, column: mi.UInt32, row: mi.UInt32) -> mi.Vector3f:
        """Return the direction through a cell's middle, one along `ahead`."""
        right = self.low[0] + (mi.Float(column) + 0.5) * self.size
        up = self.low[1] + (mi.Float(row) + 0.5) * self.size
        return right * self.axes[0] + up * self.axes[1] + self.axes[2]


@dataclass
class Sorted:
    """Rays in charts.

    Attributes:
        charts: of the rays.
        chart: (n,), chart of each ray.
        cell: (n,), cell of each ray.
        order: (n,), the rays' numbers by cell.
        cells: number of all cells.
        occupied: (cells,), 1 where there is a ray.
    """

    charts: Charts
    chart: mi.UInt32
    cell: mi.UInt32
    order: mi.UInt32
    cells: int
    occupied: mi.UInt32


def sort_rays(origin: mi.Point3f, direction: mi.Vector3f) -> Sorted:
    """Put rays into charts and cells.

    Args:
        origin: (3, n), or one for all.
        direction: (3, n), unit vectors.

    Returns:
        all of it evaluated.
    """
    direction = mi.Vector3f(direction)
    origin, view, spread = _origins(mi.Point3f(origin), dr.width(direction))
    axes = _frames(direction, view, dr.width(origin))
    ahead = dr.dot(dr.gather(mi.Vector3f, axes[2], view), direction)
    if not dr.all(ahead > NARROW):
        view, axes, origin = _faces(direction, view, axes, origin=origin)
    count = dr.width(axes[0])
    x, y, z = (dr.dot(dr.gather(mi.Vector3f, axis, view), direction) for axis in axes)
    place = [x / z, y / z]
    rays = dr.zeros(mi.UInt32, count)
    dr.scatter_reduce(dr.ReduceOp.Add, rays, mi.UInt32(1), view)
    some = rays > 0
    ends = [_extremes(p, view, count) for p in place]
    low, high = [a - _MARGIN for a, _ in ends], [b + _MARGIN for _, b in ends]
    width, height = (dr.select(some, b - a, 0) for a, b in zip(low, high, strict=True))
    size = dr.sqrt(PER_CELL * width * height / dr.maximum(rays, 1))
    size = dr.clip(size, LEAST, LARGEST)
    counts = [dr.select(some, mi.UInt32(x / size) + 1, 0) for x in (width, height)]
    first = dr.prefix_sum(counts[0] * counts[1])
    charts = Charts(
        origin,
        spread,
        axes,
        low=low,
        high=high,
        size=size,
        counts=counts,
        first=first,
        rays=rays,
    )
    dr.eval(charts)
    cells = int(dr.sum(counts[0] * counts[1])[0])
    own = pick_rays(charts, view)
    column, row = (
        dr.minimum(mi.UInt32(dr.maximum(p - a, 0) / own.size), n - 1)
        for p, a, n in zip(place, own.low, own.counts, strict=True)
    )
    cell = own.cell(column, row)
    occupied = dr.zeros(mi.UInt32, cells)
    dr.scatter(occupied, mi.UInt32(1), cell)
    dr.eval(view, cell, occupied)
    return Sorted(
        charts,
        chart=view,
        cell=cell,
        order=dr.argsort(cell),
        cells=cells,
        occupied=occupied,
    )


def _origins(origin: mi.Point3f, count: int) -> tuple[mi.Point3f, mi.UInt32, mi.Float]:
    """Return origins (3, v), the rays' numbers among them, and `Charts.spread`."""
    none = dr.opaque(mi.Float, 0)
    if dr.width(origin) == 1:
        dr.make_opaque(origin)
        return origin, dr.zeros(mi.UInt32, count), none
    index = dr.arange(mi.UInt32, count)
    before = dr.gather(mi.Point3f, origin, dr.maximum(index, 1) - 1)
    # Rays that start at one point share a view
    changes = dr.any(origin != before)
    starts = dr.compress(changes | (index == 0))
    if dr.width(starts) <= ORIGINS:
        return dr.gather(mi.Point3f, origin, starts), _numbered(changes), none
    # Else rays of one camera, which start on its near clip; else all rays
    changes = dr.squared_norm(origin - before) > APART_M**2
    starts = dr.compress(changes | (index == 0))
    if dr.width(starts) > ORIGINS:
        changes, starts = dr.zeros(mi.Bool, count), dr.opaque(mi.UInt32, 0)
    view = _numbered(changes)
    first = dr.gather(mi.Point3f, origin, starts)
    # Their mean, from sums of small numbers, which round little
    offset = mi.Vector3f(origin - dr.gather(mi.Point3f, first, view))
    total = dr.zeros(mi.Vector3f, dr.width(starts))
    rays = dr.zeros(mi.Float, dr.width(starts))
    dr.scatter_reduce(dr.ReduceOp.Add, total, offset, view)
    dr.scatter_reduce(dr.ReduceOp.Add, rays, mi.Float(1), view)
    middle = mi.Point3f(first + total / rays)
    away = dr.norm(origin - dr.gather(mi.Point3f, middle, view))
    return middle, view, dr.max(away)


def _numbered(changes: mi.Bool) -> mi.UInt32:
    """Return the number of changes up to each ray, (n,)."""
    return dr.cumsum(dr.select(changes, mi.UInt32(1), mi.UInt32(0)))


def _frames(direction: mi.Vector3f, view: mi.UInt32, count: int) -> list[mi.Vector3f]:
    """Return right, up and ahead, (3, count) each: ahead is the mean direction."""
    total = dr.zeros(mi.Vector3f, count)
    dr.scatter_reduce(dr.ReduceOp.Add, total, direction, view)
    ahead = dr.normalize(total)
    ahead = dr.select(dr.squared_norm(total) > 0, ahead, mi.Vector3f(1, 0, 0))
    right = dr.cross(ahead, mi.Vector3f(0, 0, 1))
    level = dr.squared_norm(right) > 1e-4
    right = dr.select(level, right, dr.cross(ahead, mi.Vector3f(1, 0, 0)))
    right = dr.normalize(right)
    axes = [right, dr.cross(right, ahead), ahead]
    dr.eval(axes)
    return axes


def _faces(
    direction: mi.Vector3f,
    view: mi.UInt32,
    axes: list[mi.Vector3f],
    origin: mi.Point3f,
) -> tuple[mi.UInt32, list[mi.Vector3f], mi.Point3f]:
    """Return each ray's face of its cube, and frames and origins of all faces."""
    local = [dr.dot(dr.gather(mi.Vector3f, axis, view), direction) for axis in axes]
    length = [dr.abs(x) for x in local]
    sideways = (length[0] >= length[1]) & (length[0] >= length[2])
    upright = ~sideways & (length[1] >= length[2])
    side = dr.select(sideways, mi.UInt32(0), dr.select(upright, mi.UInt32(1), 2))
    along = dr.select(sideways, local[0], dr.select(upright, local[1], local[2]))
    chart = 6 * view + 2 * side + dr.select(along < 0, mi.UInt32(1), mi.UInt32(0))
    lane = dr.arange(mi.UInt32, 6 * dr.width(axes[0]))
    base, face = lane // 6, lane % 6
    turned = [dr.gather(mi.Vector3f, axis, base) for axis in axes]
    first, second = face < 2, (face >= 2) & (face < 4)
    sign = dr.select(face % 2 == 0, mi.Float(1), mi.Float(-1))

    def choose(x: int, y: int, z: int) -> mi.Vector3f:
        others = dr.select(second, turned[y], turned[z])
        return dr.select(first, turned[x], others)

    frames = [choose(1, 2, 0), choose(2, 0, 1), sign * choose(0, 1, 2)]
    dr.eval(frames)
    return chart, frames, dr.gather(mi.Point3f, origin, base)


def _extremes(
    value: mi.Float, place: mi.UInt32, count: int
) -> tuple[mi.Float, mi.Float]:
    """Return the least and the largest value of each place, (count,).

    By numbers whose order is that of the values, since GPUs have no atomic operations
    for those of floating point.
    """
    bits = dr.reinterpret_array(mi.UInt32, value)
    rank = dr.select(bits >> 31 == 0, bits | _SIGN, ~bits)
    low, high = dr.full(mi.UInt32, 2**32 - 1, count), dr.zeros(mi.UInt32, count)
    dr.scatter_reduce(dr.ReduceOp.Min, low, rank, place)
    dr.scatter_reduce(dr.ReduceOp.Max, high, rank, place)
    bits = (dr.select(x >> 31 == 1, x ^ _SIGN, ~x) for x in (low, high))
    low, high = (mi.Float(dr.reinterpret_array(mi.Float, x)) for x in bits)
    return low, high
