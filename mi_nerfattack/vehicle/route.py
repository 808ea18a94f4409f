"""Reference path: the centre of the lane to follow, and the distance from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack import files
from mi_nerfattack.errors import InputError

#: Vehicles closer than this to a bend's vertex (metres) are measured from the
#: segment instead, because the direction to the vertex is then a rounding error.
VERTEX_RADIUS = 1e-3


@dataclass(frozen=True, eq=False)
class Route:
    """Polyline of the lane centre in the direction of travel.

    The cross-track error is the distance to the nearest point of the polyline,
    positive on its left. Before the first and beyond the last point it is measured
    from the straight prolongation, so that overshooting costs nothing.

    Args:
        name: as in the routes file.
        goal: index of the policy's one-hot goal.
        points: (n, 2), n >= 2, metres, consecutive points differ.
        lane_width_m: metres.
        speed_ms: nominal speed, metres per second.
    """

    name: str
    goal: int
    points: np.ndarray
    lane_width_m: float = 3.5
    speed_ms: float = 5.0

    def __post_init__(self) -> None:
        points = checked_points(f"route {self.name!r}", self.points)
        points.setflags(write=False)
        object.__setattr__(self, "points", points)
        if isinstance(self.goal, bool) or not isinstance(self.goal, int):
            raise InputError(f"route {self.name!r}: goal {self.goal!r}; an integer")
        if self.goal < 0:
            raise InputError(f"route {self.name!r}: goal {self.goal}; at least 0")
        for key in ("lane_width_m", "speed_ms"):
            value = getattr(self, key)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not 0 < value < float("inf"):
                raise InputError(
                    f"route {self.name!r}: {key} {value!r}; a positive number"
                )

    @classmethod
    def from_file(cls, path: str | Path, name: str) -> Route:
        """Read one route of a routes file (JSON).

        Args:
            path: file `{NAME: {"goal", "points_m", "lane_width_m", "speed_ms"}}`.
            name: key of the route.

        Raises:
            InputError: unreadable file, missing route or key, unusable value.
        """
        table = files.read_json(path)
        if not isinstance(table, dict):
            raise InputError(f"{path}: not an object with one key per route")
        if name not in table:
            known = ", ".join(map(repr, table)) or "none"
            raise InputError(f"{path}: no route {name!r}; it has {known}")
        entry = table[name]
        keys = {"goal", "points_m", "lane_width_m", "speed_ms"}
        if not isinstance(entry, dict) or not keys <= set(entry):
            raise InputError(f"{path}: route {name!r} needs {sorted(keys)}")
        try:
            return cls(
                name,
                entry["goal"],
                entry["points_m"],
                entry["lane_width_m"],
                entry["speed_ms"],
            )
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    @property
    def edges(self) -> np.ndarray:
        """Vectors between consecutive points, (n - 1, 2), metres."""
        return np.diff(self.points, axis=0)

    @property
    def edge_lengths(self) -> np.ndarray:
        """Lengths of the segments, (n - 1,), metres."""
        return np.linalg.norm(self.edges, axis=1)

    @property
    def length(self) -> float:
        """Arc length from the first to the last point, metres."""
        return float(self.edge_lengths.sum())

    def pose_at(self, s: Any, lateral: Any = 0.0, heading: Any = 0.0) -> np.ndarray:
        """Place a vehicle relative to the route.

        Args:
            s: arc length in metres, scalar or (n,); outside [0, length] on the
                prolongation of the first or last segment.
            lateral: offset to the left of the segment, metres.
            heading: angle to the segment's direction, radians.

        Returns:
            (3,) or (n, 3) state.
        """
        s, lateral, heading = np.broadcast_arrays(
            *(np.asarray(value, np.float64) for value in (s, lateral, heading))
        )
        starts = np.concatenate([[0.0], np.cumsum(self.edge_lengths)])
        last = len(starts) - 2
        index = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, last)
        direction = (self.edges / self.edge_lengths[:, None])[index]
        normal = np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
        position = (
            self.points[index]
            + (s - starts[index])[..., None] * direction
            + lateral[..., None] * normal
        )
        theta = np.arctan2(direction[..., 1], direction[..., 0]) + heading
        return np.concatenate([position, theta[..., None]], axis=-1)

    def heading_at(self, s: Any) -> np.ndarray:
        """Interpolate the direction of the route between segment centres.

        Args:
            s: arc length, metres, any shape.

        Returns:
            Radians, same shape, continuous along the route (not wrapped).
        """
        edges, lengths = self.edges, self.edge_lengths
        centres = np.cumsum(lengths) - lengths / 2
        return np.interp(s, centres, np.unwrap(np.arctan2(edges[:, 1], edges[:, 0])))

    def project_numpy(self, states: Any) -> tuple[np.ndarray, ...]:
        """Find the nearest point of the route.

        Args:
            states: (n, 3) or (3,), metres and radians.

        Returns:
            Arc length (m, beyond [0, length] on the prolongations), signed
            cross-track error (m) and heading error (radians, in [-pi, pi)), each (n,).
        """
        states = np.atleast_2d(np.asarray(states, np.float64))
        edges, lengths = self.edges, self.edge_lengths
        count, rows = len(lengths), np.arange(len(states))
        offset = states[:, None, :2] - self.points[None, :-1]
        along = (offset * edges).sum(-1) / lengths**2
        miss = offset - np.clip(along, 0, 1)[..., None] * edges
        index = np.argmin((miss**2).sum(-1), axis=1)
        t = along[rows, index]
        t = np.where(index > 0, np.maximum(t, 0), t)
        t = np.where(index < count - 1, np.minimum(t, 1), t)
        tangent = edges / lengths[:, None]
        miss = offset[rows, index] - t[:, None] * edges[index]
        neighbour = np.where(t == 1, index + 1, np.where(t == 0, index - 1, index))
        neighbour = np.clip(neighbour, 0, count - 1)
        side = tangent[index] + tangent[neighbour]
        distance = np.linalg.norm(miss, axis=1)
        left = side[:, 0] * miss[:, 1] - side[:, 1] * miss[:, 0] >= 0
        starts = np.concatenate([[0.0], np.cumsum(lengths)])
        direction = np.arctan2(tangent[index, 1], tangent[index, 0])
        turn = np.remainder(states[:, 2] - direction + np.pi, 2 * np.pi) - np.pi
        arc = starts[index] + t * lengths[index]
        return arc, np.where(left, distance, -distance), turn

    def cross_track_numpy(self, states: Any) -> np.ndarray:
        """Signed cross-track error (n,) in metres of states (n, 3)."""
        return self.project_numpy(states)[1]

    def heading_error_numpy(self, states: Any) -> np.ndarray:
        """Heading (n,) relative to the nearest segment, radians in [-pi, pi)."""
        return self.project_numpy(states)[2]

    def cross_track(self, state: Any) -> Any:
        """Signed cross-track error, differentiable in the position.

        The nearest segment is selected with the state detached, by a recorded loop
        over segments in device memory: one kernel for every route and state. The
        derivative is the unit vector from the route to the vehicle; on a medial
        axis, where it jumps, it is that of the selected side.

        Args:
            state: Dr.Jit array (3, n), metres and radians.

        Returns:
            Row (n,), metres, positive to the left.
        """
        path = _DevicePath(self, state[0])
        index = path.nearest(dr.detach(state))
        ax, ay = path.point(index)
        tx, ty, length = path.tangent(index)
        dx, dy = state[0] - ax, state[1] - ay
        lateral = tx * dy - ty * dx
        along = dr.detach(tx * dx + ty * dy)
        before = (along < 0) & (index > 0)
        after = (along > length) & (index < path.count - 1)
        neighbour = dr.select(after, index + 1, dr.select(before, index - 1, index))
        nx, ny, _ = path.tangent(neighbour)
        reach = dr.select(after, length, 0)
        mx, my = dx - reach * tx, dy - reach * ty
        square = dr.square(mx) + dr.square(my)
        at_vertex = (before | after) & (dr.detach(square) > VERTEX_RADIUS**2)
        distance = dr.sqrt(dr.select(at_vertex, square, 1))
        side = dr.detach((tx + nx) * my - (ty + ny) * mx)
        return dr.select(at_vertex, dr.copysign(distance, side), lateral)

    def heading_error(self, state: Any) -> Any:
        """Heading relative to the nearest segment.

        Args:
            state: Dr.Jit array (3, n), metres and radians.

        Returns:
            Row (n,), radians in (-pi, pi], differentiable in the heading.
        """
        path = _DevicePath(self, state[0])
        tx, ty, _ = path.tangent(path.nearest(dr.detach(state)))
        sin, cos = dr.sincos(state[2])
        return dr.atan2(tx * sin - ty * cos, tx * cos + ty * sin)


class _DevicePath:
    """The points of a route in the memory of a Dr.Jit backend."""

    def __init__(self, route: Route, like: Any) -> None:
        """Upload `route` as arrays of the type of the row `like`."""
        self.real: Any = dr.detached_t(type(like))
        self.integer: Any = dr.uint32_array_t(self.real)
        # lists: memory from NumPy has an alignment of its own, and so its own kernels
        self.x, self.y = (self.real(column) for column in route.points.T.tolist())
        self.count = dr.opaque(self.integer, len(route.points) - 1)

    def point(self, index: Any) -> tuple[Any, Any]:
        """Look up the coordinates of points."""
        index = self.integer(index)
        return dr.gather(self.real, self.x, index), dr.gather(self.real, self.y, index)

    def tangent(self, index: Any) -> tuple[Any, Any, Any]:
        """Look up the unit direction and the length of segments."""
        (ax, ay), (bx, by) = self.point(index), self.point(index + 1)
        length = dr.hypot(bx - ax, by - ay)
        return (bx - ax) / length, (by - ay) / length, length

    def nearest(self, state: Any) -> Any:
        """Find for each vehicle the first of the nearest segments, (n,)."""
        px, py = self.real(state[0]), self.real(state[1])

        def measure(i: Any, best: Any, shortest: Any) -> tuple[Any, Any, Any]:
            (ax, ay), (tx, ty, length) = self.point(i), self.tangent(i)
            dx, dy = px - ax, py - ay
            along = dr.clip(tx * dx + ty * dy, 0, length)
            square = dr.square(dx - along * tx) + dr.square(dy - along * ty)
            closer = square < shortest
            return (
                i + 1,
                dr.select(closer, i, best),
                dr.select(closer, square, shortest),
            )

        start = dr.zeros(self.integer, dr.width(px))
        _, best, _ = dr.while_loop(
            (start, dr.zeros_like(start), dr.full(self.real, dr.inf, dr.width(px))),
            lambda i, best, shortest: i < self.count,
            measure,
            labels=("segment", "nearest", "square_distance"),
            mode="symbolic",
        )
        return best


def checked_points(owner: str, points: Any) -> np.ndarray:
    """Copy a polyline to (n, 2) float64.

    Raises:
        InputError: not numbers of that shape, fewer than two points, a value that
            is not finite, or two equal consecutive points.
    """
    try:
        array = np.array(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{owner}: points are not pairs of numbers") from error
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < 2:
        raise InputError(
            f"{owner}: points of shape {array.shape}; at least two pairs x, y"
        )
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).all(axis=1)))
        raise InputError(f"{owner}: point {row} is {array[row].tolist()}; finite only")
    repeated = np.flatnonzero((np.diff(array, axis=0) == 0).all(axis=1))
    if len(repeated):
        row = int(repeated[0])
        raise InputError(
            f"{owner}: points {row} and {row + 1} are both {array[row].tolist()}; "
            "remove one"
        )
    return array


def smooth_absolute(error: Any, width: float = 0.05) -> Any:
    """Absolute value that is differentiable at zero: `sqrt(e^2 + w^2) - w`.

    Args:
        error: (n,), metres.
        width: w, metres, radius of the rounded corner.

    Returns:
        (n,), metres, between |e| - w and |e|.
    """
    return dr.sqrt(dr.square(error) + width**2) - width
