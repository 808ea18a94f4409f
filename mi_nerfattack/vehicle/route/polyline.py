"""Projection onto a polyline, in the arrays of any library.

Everything that a projection needs to know about a segment is a row of numbers, made
once in float64 (`segment_rows`). What remains, `square_distance` to choose a segment
and `measure` against it, is written in `Operations`, which NumPy, Dr.Jit and torch
name differently; so all three compute the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mi_nerfattack.errors import InputError

#: Vehicles closer than this to a bend's vertex (metres) are measured from the
#: segment instead, because the direction to the vertex is then a rounding error.
VERTEX_RADIUS = 1e-3

#: Largest coordinate of a route's point, metres.
LARGEST_M = 1e9


@dataclass(frozen=True)
class Operations:
    """Functions of an array library; `detach` takes a value as a constant."""

    where: Callable[..., Any]
    sqrt: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    arctan2: Callable[[Any, Any], Any]
    detach: Callable[[Any], Any]


class Segment(NamedTuple):
    """Segments of a polyline; each entry is an array with one number per segment.

    `low` and `high` bound the distance from the start along the segment, metres. They
    are 0 and the segment's length where another segment joins, and infinite at the ends
    of an open polyline, which goes on straight. The directions `start_` and `end_`
    halve the bends to the neighbours. `lap` is the length of a closed polyline;
    infinite for an open one.
    """

    x: Any
    y: Any
    tangent_x: Any
    tangent_y: Any
    length: Any
    arc: Any
    low: Any
    high: Any
    start_x: Any
    start_y: Any
    end_x: Any
    end_y: Any
    lap: Any


class Measures(NamedTuple):
    """Arc length, signed cross-track error (metres) and heading error (radians)."""

    arc_length: Any
    cross_track: Any
    heading_error: Any


def segment_rows(points: np.ndarray, closed: bool) -> np.ndarray:
    """Compute the numbers of each segment.

    Args:
        points: (n, 2), metres, consecutive ones differ.
        closed: whether a segment leads from the last point to the first.

    Returns:
        (k, 13) float64, a row for each segment in the order of `Segment`.
    """
    edges = edges_of(points, closed)
    length = np.hypot(*edges.T)
    tangent = edges / length[:, None]
    joined = np.full((2, len(edges)), True)
    if not closed:
        joined[0, 0] = joined[1, -1] = False
    end = np.where(
        joined[1, :, None], _bisector(tangent, np.roll(tangent, -1, 0)), tangent
    )
    start = np.where(joined[0, :, None], np.roll(end, 1, 0), tangent)
    columns = [
        *points[: len(edges)].T,
        *tangent.T,
        length,
        np.append(0.0, np.cumsum(length)[:-1]),
        np.where(joined[0], 0.0, -np.inf),
        np.where(joined[1], length, np.inf),
        *start.T,
        *end.T,
        np.full(len(edges), np.cumsum(length)[-1] if closed else np.inf),
    ]
    return np.stack(columns, axis=1)


def edges_of(points: np.ndarray, closed: bool) -> np.ndarray:
    """Return the vectors (k, 2) from each point to the next, metres."""
    after = np.roll(points, -1, 0)
    return after - points if closed else (after - points)[:-1]


def _bisector(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Halve bends between unit vectors (k, 2); a reversal counts as one to the left."""
    total = before + after
    size = np.hypot(*total.T)[:, None]
    left = np.stack([-before[:, 1], before[:, 0]], axis=1)
    return np.where(size > 1e-9, total / np.maximum(size, 1e-9), left)


def square_distance(ops: Operations, segment: Segment, x: Any, y: Any) -> Any:
    """Return squared distances of points from segments, square metres."""
    dx, dy = x - segment.x, y - segment.y
    along = segment.tangent_x * dx + segment.tangent_y * dy
    after = ops.where(along > segment.length, segment.length, along)
    foot = ops.where(along < 0, 0, after)
    dx, dy = dx - foot * segment.tangent_x, dy - foot * segment.tangent_y
    return dx * dx + dy * dy


def measure(ops: Operations, segment: Segment, x: Any, y: Any, theta: Any) -> Measures:
    """Measure vehicles against their nearest segments.

    Along a segment, the arc length grows with the distance from the segment's start. On
    the outer side of a bend the vertex is nearest. There the arc length is the arc
    length at the vertex, the direction is the one that halves the bend, and the error
    is the distance from the vertex.

    Args:
        ops: functions of the arrays' library.
        segment: each entry (n,), constants.
        x: metres, (n,).
        y: metres, (n,).
        theta: heading, radians, (n,).

    Returns:
        Rows (n,): arc length, in [0, lap) on a loop; cross-track error, positive on
        the left; heading error in [-pi, pi]. Differentiable but where they jump: on
        medial axes and, the heading error, where the direction changes.
    """
    tx, ty = segment.tangent_x, segment.tangent_y
    dx, dy = x - segment.x, y - segment.y
    along, lateral = tx * dx + ty * dy, tx * dy - ty * dx
    reached = ops.detach(along)
    before, after = reached < segment.low, reached > segment.high
    reach = ops.where(after, segment.length, 0)
    mx, my = dx - reach * tx, dy - reach * ty
    square = mx * mx + my * my
    at_vertex = (before | after) & (ops.detach(square) > VERTEX_RADIUS**2)
    middle_x = ops.where(after, segment.end_x, segment.start_x)
    middle_y = ops.where(after, segment.end_y, segment.start_y)
    side = ops.detach(middle_x * my - middle_y * mx)
    distance = ops.sqrt(ops.where(at_vertex, square, 1))
    outside = ops.where(side >= 0, distance, -distance)
    arc = segment.arc + ops.where(before | after, reach, along)
    ux, uy = ops.where(at_vertex, middle_x, tx), ops.where(at_vertex, middle_y, ty)
    sin, cos = ops.sin(theta), ops.cos(theta)
    return Measures(
        ops.where(arc >= segment.lap, arc - segment.lap, arc),
        ops.where(at_vertex, outside, lateral),
        ops.arctan2(ux * sin - uy * cos, ux * cos + uy * sin),
    )


def checked_points(owner: str, points: Any, closed: bool = False) -> np.ndarray:
    """Copy a polyline to (n, 2) float64.

    Raises:
        InputError: not numbers of that shape, fewer than two points (three of a
            closed one), a value that is not finite or too large, or two equal
            consecutive points.
    """
    try:
        array = np.array(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{owner}: points are not pairs of numbers") from error
    least, word = (3, "three") if closed else (2, "two")
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < least:
        kind = " of a closed route" if closed else ""
        raise InputError(
            f"{owner}: points{kind} of shape {array.shape}; at least {word} pairs x, y"
        )
    usable = (np.abs(array) <= LARGEST_M).all(axis=1)  # false for NaN
    if not usable.all():
        row = int(np.argmin(usable))
        raise InputError(
            f"{owner}: point {row} is {array[row].tolist()}; finite, and at most "
            f"{LARGEST_M:g} m"
        )
    repeated = np.flatnonzero((edges_of(array, closed) == 0).all(axis=1))
    if len(repeated):
        row = int(repeated[0])
        after = (row + 1) % len(array)
        hint = "; a closed route returns by itself" if after == 0 else ""
        raise InputError(
            f"{owner}: points {row} and {after} are both {array[row].tolist()}; "
            f"remove one{hint}"
        )
    return array
