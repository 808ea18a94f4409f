"""Reference path: the centre of the lane to follow, and the distance from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near
from mi_nerfattack.notebook import picture
from mi_nerfattack.ranges import Natural, Positive, checked
from mi_nerfattack.vehicle.route.polyline import (
    Measures,
    Operations,
    Segment,
    checked_points,
    edges_of,
    measure,
    segment_rows,
    square_distance,
)

_NEEDED = ("goal", "points_m", "lane_width_m", "speed_ms")
_NUMPY = Operations(
    np.where, np.sqrt, np.sin, cos=np.cos, arctan2=np.arctan2, detach=lambda x: x
)


@dataclass(frozen=True, eq=False)
@checked("route {self.name!r}")
class Route:
    """Polyline of the lane centre in the direction of travel.

    The cross-track error is the distance to the nearest point of the polyline,
    positive on its left. Before the first and beyond the last point it is measured
    from the straight prolongation, so that overshooting costs nothing. A closed route
    leads from the last point to the first and has no ends: its arc length wraps.

    Args:
        name: as in the routes file.
        goal: index of the policy's one-hot goal.
        points: (n, 2), metres, consecutive points differ; n >= 2, of a closed route
            n >= 3, and the first is not repeated.
        lane_width_m: metres.
        speed_ms: nominal speed, metres per second.
        closed: whether it is a loop.
    """

    name: str
    goal: Natural
    points: np.ndarray
    lane_width_m: Positive = 3.5
    speed_ms: Positive = 5.0
    closed: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.closed, bool):
            raise InputError(
                f"route {self.name!r}: closed {self.closed!r}; true or false"
            )
        points = checked_points(f"route {self.name!r}", self.points, self.closed)
        require_near(f"route {self.name!r}", points)
        points.setflags(write=False)
        object.__setattr__(self, "points", points)

    def __repr__(self) -> str:
        points = f"{len(self.points)} points" + ", closed" * self.closed
        return (
            f"Route({self.name!r}, goal {self.goal}, {points}, "
            f"{self.length:.1f} m, lane {self.lane_width_m:g} m, {self.speed_ms:g} m/s)"
        )

    def _repr_png_(self) -> bytes:
        return picture(self)

    @classmethod
    def from_file(cls, path: str | Path, name: str) -> Route:
        """Read one route of a routes file (JSON).

        Args:
            path: file `{NAME: {"goal", "points_m", "lane_width_m", "speed_ms"}}`,
                optionally with `"closed": true`.
            name: key of the route.

        Raises:
            InputError: unreadable file, missing route or key, unusable value.
        """
        table = _read_table(path)
        if name not in table:
            known = ", ".join(map(repr, table))
            raise InputError(f"{path}: no route {name!r}; it has {known}")
        entry = table[name]
        if not isinstance(entry, dict) or not set(entry) >= set(_NEEDED):
            raise InputError(f"{path}: route {name!r} needs {', '.join(_NEEDED)}")
        goal, points, lane_width_m, speed_ms = (entry[key] for key in _NEEDED)
        closed = entry.get("closed", False)
        try:
            return cls(name, goal, points, lane_width_m, speed_ms, closed)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def document(self) -> dict[str, Any]:
        """Return the route's entry of a routes file."""
        return {
            "goal": self.goal,
            "points_m": self.points.tolist(),
            "lane_width_m": self.lane_width_m,
            "speed_ms": self.speed_ms,
            **({"closed": True} if self.closed else {}),
        }

    @cached_property
    def segments(self) -> np.ndarray:
        """Numbers of the k segments, (k, 13), read-only; see `polyline.Segment`."""
        rows = segment_rows(self.points, self.closed)
        rows.setflags(write=False)
        return rows

    @property
    def edges(self) -> np.ndarray:
        """Vectors from each point to the next, (k, 2), metres."""
        return edges_of(self.points, self.closed)

    @property
    def edge_lengths(self) -> np.ndarray:
        """Lengths of the segments, (k,), metres."""
        return np.array(Segment(*self.segments.T).length)

    @property
    def length(self) -> float:
        """Arc length from the first to the last point, or around, metres."""
        return float(self.edge_lengths.sum())

    def pose_at(self, s: Any, lateral: Any = 0.0, heading: Any = 0.0) -> np.ndarray:
        """Place a vehicle relative to the route.

        Args:
            s: arc length in metres, scalar or (n,); outside [0, length] on the
                prolongation of the first or last segment, or on another lap.
            lateral: offset to the left of the segment, metres.
            heading: angle to the segment's direction, radians.

        Returns:
            (3,) or (n, 3) state.
        """
        s, lateral, heading = np.broadcast_arrays(
            *(np.asarray(value, np.float64) for value in (s, lateral, heading))
        )
        s = s % self.length if self.closed else s
        starts = Segment(*self.segments.T).arc
        index = np.maximum(np.searchsorted(starts, s, side="right") - 1, 0)
        at = Segment(*np.moveaxis(self.segments[index], -1, 0))
        along = s - at.arc
        x = at.x + along * at.tangent_x - lateral * at.tangent_y
        y = at.y + along * at.tangent_y + lateral * at.tangent_x
        theta = np.arctan2(at.tangent_y, at.tangent_x) + heading
        return np.stack([x, y, theta], axis=-1)

    def heading_at(self, s: Any) -> np.ndarray:
        """Interpolate the direction of the route between segment centres.

        Args:
            s: arc length, metres, any shape.

        Returns:
            Radians, same shape, continuous along the route and not wrapped: each lap
            of a closed one adds its whole turn.
        """
        s, edges, lengths = np.asarray(s, np.float64), self.edges, self.edge_lengths
        centres = np.cumsum(lengths) - lengths / 2
        direction = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
        if not self.closed:
            return np.interp(s, centres, direction)
        around = np.unwrap([direction[-1], direction[0]])[1] - direction[0]
        laps = np.floor(s / self.length)
        return laps * around + np.interp(
            s - laps * self.length,
            [centres[-1] - self.length, *centres, centres[0] + self.length],
            [direction[-1] - around, *direction, direction[0] + around],
        )

    def curvature_at(self, s: Any, window: float) -> np.ndarray:
        """Average the curvature of the route, positive to the left.

        Args:
            s: arc length, metres, any shape.
            window: arc length around `s` that counts, metres.

        Returns:
            1 / metres, same shape.
        """
        start = np.asarray(s, np.float64) - window / 2
        return (self.heading_at(start + window) - self.heading_at(start)) / window

    def project_numpy(self, states: Any) -> Measures:
        """Find the nearest point of the route.

        Args:
            states: (n, m) or (m,), m >= 3, metres and radians.

        Returns:
            Arc length (m, beyond [0, length] on the prolongations, in [0, length) of
            a closed route), signed cross-track error (m) and heading error (radians,
            in [-pi, pi]), each (n,).
        """
        x, y, theta = np.atleast_2d(np.asarray(states, np.float64)).T[:3]
        every = Segment(*self.segments.T)
        square = square_distance(_NUMPY, every, x[:, None], y=y[:, None])
        nearest = Segment(*self.segments[np.argmin(square, axis=1)].T)
        return measure(_NUMPY, nearest, x, y=y, theta=theta)

    def cross_track_numpy(self, states: Any) -> np.ndarray:
        """Signed cross-track error (n,) in metres of states (n, m)."""
        return self.project_numpy(states).cross_track

    def project(self, state: Any) -> Measures:
        """Find the nearest point of the route, differentiably.

        The nearest segment is selected with the state detached, by a recorded loop
        over segments in device memory: one kernel for every route and state. On a
        medial axis, where they jump, derivatives are those of the selected side.

        Args:
            state: Dr.Jit array (m, n), m >= 3, metres and radians.

        Returns:
            Rows (n,), as those of `project_numpy`.
        """
        return _project(self.segments, state)

    def arc_length(self, state: Any) -> Any:
        """Arc length (n,) of :meth:`project`, metres, of states (m, n).

        Its derivative is the route's direction, zero where a bend's vertex is nearest.
        """
        return self.project(state).arc_length

    def cross_track(self, state: Any) -> Any:
        """Signed distance (n,) of :meth:`project`, metres, positive on the left.

        Its derivative is the unit vector from the route to the vehicle.
        """
        return self.project(state).cross_track

    def heading_error(self, state: Any) -> Any:
        """Heading (n,) of :meth:`project`, radians in [-pi, pi]."""
        return self.project(state).heading_error

    def ahead(self, state: Any, distances_m: Sequence[float]) -> list[Any]:
        """Find points further on, as vehicles see them; differentiable in the state.

        A point beyond the ends of an open route lies on the straight prolongation.

        Args:
            state: Dr.Jit array (m, n), m >= 3, metres and radians.
            distances_m: arc lengths from the nearest point of the route, metres.

        Returns:
            Two rows (n,) a distance: metres forward and to the left of the vehicle.
        """
        return _ahead(self, state, distances_m)


class _Segments:
    """Segments in device memory, for one kernel whatever the route.

    Args:
        segments: (k, 13), of `Route.segments`.
        real: type of a row of states, detached.
    """

    def __init__(self, segments: np.ndarray, real: Any) -> None:
        import drjit as dr  # which the computer of a car may lack

        self.integer: Any = dr.uint32_array_t(real)
        self._real = real
        # a list: memory from NumPy has an alignment of its own, and so its own kernels
        self._rows = real(segments.ravel().tolist())
        self.count: Any = dr.opaque(self.integer, len(segments))

    def at(self, index: Any) -> Segment:
        """Return the numbers of segments, (n,) each."""
        import drjit as dr

        size = len(Segment._fields)
        start = size * self.integer(index)
        columns = (dr.gather(self._real, self._rows, start + i) for i in range(size))
        return Segment(*columns)

    def holding(self, arc: Any) -> Segment:
        """Return the segments in which arc lengths (n,), metres, lie; constants."""
        import drjit as dr

        arc = self._real(dr.detach(arc))
        start = dr.ones(self.integer, dr.width(arc))
        _, index = dr.while_loop(
            (start, dr.zeros_like(start)),
            lambda i, last: i < self.count,
            lambda i, last: (i + 1, dr.select(self.at(i).arc <= arc, i, last)),
            labels=("segment", "last"),
            mode="symbolic",
        )
        return self.at(index)


def _ahead(route: Route, state: Any, distances_m: Sequence[float]) -> list[Any]:
    """Find points of the route, as `Route.ahead` does."""
    import drjit as dr

    real: Any = dr.detached_t(type(state[0]))
    segments, arc = _Segments(route.segments, real), route.arc_length(state)
    sin, cos = dr.sincos(state[2])
    lap = dr.opaque(real, route.length)
    rows = []
    for distance in distances_m:
        s = arc + dr.opaque(real, distance)
        if route.closed:
            s = s - lap * dr.floor(dr.detach(s) / lap)
        at = segments.holding(s)
        along = s - at.arc
        dx = at.x + along * at.tangent_x - state[0]
        dy = at.y + along * at.tangent_y - state[1]
        rows += [cos * dx + sin * dy, cos * dy - sin * dx]
    return rows


def _project(segments: np.ndarray, state: Any) -> Measures:
    """Find the nearest point of the segments, as `Route.project` does."""
    import drjit as dr

    drjit = Operations(
        dr.select, dr.sqrt, dr.sin, cos=dr.cos, arctan2=dr.atan2, detach=dr.detach
    )
    real: Any = dr.detached_t(type(state[0]))
    stored, detached = _Segments(segments, real), dr.detach(state)
    px, py = real(detached[0]), real(detached[1])

    def measure_one(i: Any, best: Any, shortest: Any) -> tuple[Any, Any, Any]:
        square = square_distance(drjit, stored.at(i), px, y=py)
        closer = square < shortest
        return i + 1, dr.select(closer, i, best), dr.select(closer, square, shortest)

    # the first of the nearest segments of each vehicle
    start = dr.zeros(stored.integer, dr.width(px))
    _, nearest, _ = dr.while_loop(
        (start, dr.zeros_like(start), dr.full(real, dr.inf, dr.width(px))),
        lambda i, best, shortest: i < stored.count,
        measure_one,
        labels=("segment", "nearest", "square_distance"),
        mode="symbolic",
    )
    return measure(drjit, stored.at(nearest), state[0], y=state[1], theta=state[2])


def smooth_absolute(error: Any, width: float = 0.05) -> Any:
    """Absolute value that is differentiable at zero: `sqrt(e^2 + w^2) - w`.

    Args:
        error: (n,), metres.
        width: w, metres, radius of the rounded corner.

    Returns:
        (n,), metres, between ``|e| - w`` and ``|e|``.
    """
    import drjit as dr

    return dr.sqrt(dr.square(error) + width**2) - width


def load_routes(path: str | Path, names: Sequence[str] = ()) -> list[Route]:
    """Read routes of a file, all without names; raises as `Route.from_file`."""
    return [Route.from_file(path, name) for name in names or _read_table(path)]


def _read_table(path: str | Path) -> dict[str, Any]:
    if Path(path).suffix.lower() == ".csv":
        keys = ", ".join(_NEEDED)
        raise InputError(f"{path}: routes are JSON; write {{NAME: {{{keys}}}}}")
    table = files.read_json(path)
    if not isinstance(table, dict) or not table:
        raise InputError(f"{path}: needs an object with one key per route")
    return table
