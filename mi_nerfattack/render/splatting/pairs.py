"""Lists of the splats that rays may meet, cell by cell, the nearest first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.rays import pick_rays
from mi_nerfattack.render.splatting.charts import Charts, Sorted

REACH = 3.0  # standard deviations at which a splat ends

_MARGIN = 1e-6  # of an extent in a chart
_MOST_PAIRS = 2.0**31
_WIDER = 1.003  # rounding errs by less, but for splats like needles
_NEAREST, _OCTAVES = 2.0**-12, 28  # metres, and range of the depths that are sorted


class Shapes:
    """n ellipsoids in the world, as kernels read them.

    Args:
        centers: (n, 3), metres.
        scales: (n, 3) standard deviations, metres.
        rotations: (n, 3, 3), axes to the world.
    """

    def __init__(
        self, centers: np.ndarray, scales: np.ndarray, rotations: np.ndarray
    ) -> None:
        self.count = len(centers)
        reach = REACH * scales.max(1, keepdims=True)
        #: (4 n,), centres, and radii of balls that contain what is seen of them.
        self.balls = upload(mi.Float, np.concatenate([centers, reach], 1))
        #: (12 n,), the rows of diag(1/s) R^T.
        self.rows = upload_fours(rotations.transpose(0, 2, 1) / scales[:, :, None])
        #: (12 n,), the rows of R diag(3 s).
        self.axes = upload_fours(REACH * rotations * scales[:, None, :])

    def arrays(self) -> list[Any]:
        """Return all that kernels read."""
        return [self.balls, self.rows, self.axes]


@dataclass
class Near:
    """k splats in charts, as rays meet them.

    Attributes:
        splat: (k,), which ones.
        chart: (k,), in which.
        ahead: (3, k), from the chart's origin to the centre, metres.
        records: (12 k,), the rows of diag(1/s) R^T, and their products with the
            chart's origin less the centre.
    """

    splat: mi.UInt32
    chart: mi.UInt32
    ahead: mi.Vector3f
    records: mi.Float


@dataclass
class Lists:
    """What rays may meet.

    Attributes:
        near: the splats.
        index: (p,), indices of them, by cell and depth.
        start: (cells,), where the list of a cell begins.
        length: (cells,), and how long it is.
    """

    near: Near
    index: mi.UInt32
    start: mi.UInt32
    length: mi.UInt32


@dataclass
class _Extent:
    """Cells of their charts that k splats may be seen in: a rectangle each.

    Attributes:
        begin: two (k,), the first column and row.
        columns: (k,).
        cells: (k,), 0 for those that are not seen.
    """

    begin: list[mi.UInt32]
    columns: mi.UInt32
    cells: mi.UInt32


def list_splats(shapes: Shapes, rays: Sorted) -> Lists | None:
    """Return what rays may meet, evaluated; None where that is nothing.

    No splat that a ray meets is missing from the list of its cell. The order is that of
    the splats' peaks on the line through the middle of the cell.
    """
    lane = _visible(shapes, rays.charts)
    if not dr.width(lane):
        return None
    near, extent = _project(shapes, rays.charts, lane)
    if not dr.any(extent.cells > 0):
        return None
    key, owner, shift = _order(rays, near, *_expand(extent))
    if not dr.width(owner):
        return None
    order = dr.argsort(key)
    index = dr.gather(mi.UInt32, owner, order)
    length = dr.zeros(mi.UInt32, rays.cells)
    dr.scatter_reduce(dr.ReduceOp.Add, length, mi.UInt32(1), key >> shift)
    start = dr.prefix_sum(length)
    dr.eval(index, start, length)
    return Lists(near, index, start, length=length)


def _visible(shapes: Shapes, charts: Charts) -> mi.UInt32:
    """Return the numbers of those pairs of a chart and a splat that may be seen."""
    lane = dr.arange(mi.UInt32, shapes.count * dr.width(charts.size))
    _, _, own, ball = _take_apart(shapes, charts, lane)
    x, y, z = own.local(ball.xyz - own.origin)
    reach = ball.w + own.spread
    visible = (own.rays > 0) & (z > -reach)
    for place, low, high in zip((x, y), own.low, own.high, strict=True):
        visible &= place - low * z > -reach * dr.sqrt(1 + low * low)
        visible &= high * z - place > -reach * dr.sqrt(1 + high * high)
    return dr.compress(visible)


def _take_apart(
    shapes: Shapes, charts: Charts, lane: mi.UInt32
) -> tuple[mi.UInt32, mi.UInt32, Charts, Any]:
    """Return of numbered pairs the charts' and splats' numbers, charts and balls."""
    chart = lane // shapes.count
    splat = lane - chart * shapes.count
    ball = dr.gather(mi.Vector4f, shapes.balls, splat)
    return chart, splat, pick_rays(charts, chart), ball


def _project(shapes: Shapes, charts: Charts, lane: mi.UInt32) -> tuple[Near, _Extent]:
    """Return splats as rays of their charts meet them, and where they may be seen."""
    chart, splat, own, ball = _take_apart(shapes, charts, lane)
    ahead = mi.Vector3f(ball.xyz - own.origin)
    rows, _ = gather_rows(shapes.rows, splat)
    records = lay_out_fours([*rows[0], *rows[1], *rows[2], *turn(rows, -ahead)])
    axes, _ = gather_rows(shapes.axes, splat)
    extent = _extent(own, ahead, axes)
    near = Near(splat, chart, ahead, records=records)
    dr.eval(near, extent)
    return near, extent


def _extent(own: Charts, ahead: mi.Vector3f, axes: list[mi.Vector3f]) -> _Extent:
    """Bound ellipsoids in their charts.

    A line n of the chart touches an ellipsoid at c with the covariance S, times the
    square of its reach, where ``n^T (S - c c^T) n = 0``. So its edges are the roots of
    a quadratic equation, unless it reaches behind the origin.
    """
    x, y, z = own.local(ahead)
    turned = [a.x * axes[0] + a.y * axes[1] + a.z * axes[2] for a in own.axes]
    # A ball around each point contains those that rays start from
    grown = dr.select(own.spread > 0, mi.Float(2), mi.Float(1))
    padding = 2 * dr.square(own.spread)
    deep = grown * dr.squared_norm(turned[2]) + padding
    room = dr.square(z) - deep
    is_ahead = (z > 0) & (room > 1e-4 * dr.square(z))
    visible = (z > 0) | (room < 0)
    begin, counts = [], []
    for k, place in enumerate((x, y)):
        low, high = own.low[k], own.high[k]
        wide = grown * dr.squared_norm(turned[k]) + padding
        mixed = grown * dr.dot(turned[k], turned[2])
        for sign, edge in ((1, low), (-1, high)):
            beyond = wide - 2 * edge * mixed + dr.square(edge) * deep
            reach = dr.sqrt(dr.maximum(beyond, 0))
            visible &= sign * (place - edge * z) > -reach
        root = wide * dr.square(z) - 2 * mixed * place * z + deep * dr.square(place)
        root = dr.sqrt(dr.maximum(root + dr.square(mixed) - wide * deep, 0))
        middle = place * z - mixed
        near = dr.select(is_ahead, (middle - root) / room - _MARGIN, low)
        far = dr.select(is_ahead, (middle + root) / room + _MARGIN, high)
        near, far = dr.clip(near, low, high), dr.clip(far, low, high)
        last = dr.minimum(mi.UInt32((far - low) / own.size), own.counts[k] - 1)
        begin.append(dr.minimum(mi.UInt32((near - low) / own.size), last))
        counts.append(last - begin[k] + 1)
    return _Extent(begin, counts[0], dr.select(visible, counts[0] * counts[1], 0))


def _expand(extent: _Extent) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """Return, for each pair of a splat and a cell, the splat, column and row.

    Raises:
        InputError: there are more than memory takes.
    """
    if dr.sum(mi.Float(extent.cells))[0] > _MOST_PAIRS:
        raise InputError(
            "splats: more than two billion pairs of a splat and a cell of rays; render "
            "fewer views at once, or remove the largest splats"
        )
    count = int(dr.sum(extent.cells)[0])
    offset = dr.prefix_sum(extent.cells)
    owner = dr.zeros(mi.UInt32, count)
    index = dr.arange(mi.UInt32, dr.width(extent.cells))
    dr.scatter(owner, index, offset, extent.cells > 0)
    owner = dr.prefix_reduce(dr.ReduceOp.Max, owner, exclusive=False)
    within = dr.arange(mi.UInt32, count) - dr.gather(mi.UInt32, offset, owner)
    columns = dr.maximum(dr.gather(mi.UInt32, extent.columns, owner), 1)
    down = within // columns
    column, row = (dr.gather(mi.UInt32, first, owner) for first in extent.begin)
    return owner, column + within - down * columns, row + down


def _order(
    rays: Sorted, near: Near, owner: mi.UInt32, column: mi.UInt32, row: mi.UInt32
) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """Return keys and splats of the pairs that rays may meet, and the depth's bits.

    A splat's distance from a ray, in standard deviations, is ``|o x d| / |d|`` with o
    and d in units of them. From the middle of the cell to a ray, d moves by less than
    the sum of half the cell's edges in these units, which bounds both lengths.
    """
    own = pick_rays(rays.charts, dr.gather(mi.UInt32, near.chart, owner))
    cell = own.cell(column, row)
    rows, start = gather_rows(near.records, owner)
    middle = own.middle(column, row)
    ray, right, up = (turn(rows, x) for x in (middle, own.axes[0], own.axes[1]))
    half = 0.5 * own.size

    def bound(of: Any) -> tuple[mi.Float, mi.Float]:
        return dr.norm(of(ray)), half * (dr.norm(of(right)) + dr.norm(of(up)))

    distance, by_cell = bound(lambda vector: dr.cross(start, vector))
    length, longer = bound(lambda vector: vector)
    meets = distance - by_cell <= _WIDER * REACH * (length + longer)
    meets |= own.spread > 0  # then the records are of other rays
    meets &= dr.gather(mi.UInt32, rays.occupied, cell) > 0
    peak = -dr.dot(start, ray) / dr.square(length) * dr.norm(middle)
    bits = 32 - max(rays.cells - 1, 1).bit_length()
    shift, steps = dr.opaque(mi.UInt32, bits), dr.opaque(mi.Float, 2.0**bits - 1)
    depth = dr.log2(dr.maximum(peak, _NEAREST) / _NEAREST) / _OCTAVES
    key = (cell << shift) | mi.UInt32(dr.minimum(depth, 0.999999) * steps)
    index = dr.compress(meets)
    key, owner = (dr.gather(mi.UInt32, value, index) for value in (key, owner))
    dr.eval(key, owner)
    return key, owner, shift


def upload_fours(rows: np.ndarray) -> mi.Float:
    """Upload rows (n, ...), each filled up to a multiple of four numbers."""
    flat = rows.reshape(len(rows), -1)
    room = np.zeros((len(flat), -flat.shape[1] % 4))
    return upload(mi.Float, np.concatenate([flat, room], 1))


def gather_fours(values: mi.Float, index: mi.UInt32, count: int, *mask: Any) -> list:
    """Return `count` numbers of each row of :func:`upload_fours`, (n,) each."""
    size = -(-count // 4)
    fours = [
        dr.gather(mi.Vector4f, values, size * index + k, *mask) for k in range(size)
    ]
    return [value for four in fours for value in four][:count]


def lay_out_fours(values: list[mi.Float]) -> mi.Float:
    """Lay numbers (k,) out row by row, for :func:`gather_fours`: 4 n of them."""
    size, place = len(values) // 4, dr.arange(mi.UInt32, dr.width(values[0]))
    result = dr.zeros(mi.Float, len(values) * dr.width(values[0]))
    for k in range(size):
        part = mi.Vector4f(*values[4 * k : 4 * k + 4])
        dr.scatter(result, part, size * place + k)
    return result


def gather_rows(
    values: mi.Float, index: mi.UInt32, *mask: Any
) -> tuple[list[mi.Vector3f], mi.Vector3f]:
    """Return the rows of matrices, (3, n) each, and the three numbers after them."""
    v = gather_fours(values, index, 12, *mask)
    return [mi.Vector3f(*v[k : k + 3]) for k in (0, 3, 6)], mi.Vector3f(*v[9:])


def turn(rows: list[mi.Vector3f], vector: mi.Vector3f) -> mi.Vector3f:
    """Return products of matrices, by their rows, with vectors (3, n)."""
    return mi.Vector3f(*(dr.dot(row, vector) for row in rows))
