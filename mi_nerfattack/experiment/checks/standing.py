"""Where objects stand: on the lane, in walls, in the air, in each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.attack.base import Freedom
from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.route.route import Route

#: A car takes the space between these heights, metres above z = 0, where it drives.
CAR_M = (0.1, 2.0)
#: How far an object may reach into a surface, and how far it may be from all of them.
DEPTH_M, GAP_M = 0.1, 0.2
#: Share of an object's solid points that may lie in walls, or in another object.
SHARE = 0.02

_CELLS = 32  # along each axis of an object's box
_MOST_POINTS = 4096
_AHEAD_M = (-12.0, -6.0, 0.0, 6.0, 12.0)  # along the lane, of points in the open
_OPEN_HEIGHT_M = 1.0
_MOST_SURFACES = 64  # along a line
_AXES = np.concatenate([np.eye(3), -np.eye(3)])  # the last one points down


@dataclass(frozen=True, eq=False)
class Solid:
    """An object as points.

    A point is solid where matter of its density, as thick as the object's box is
    long, lets less than 1 / e of the light through.

    Attributes:
        name: its id.
        posed: the object.
        points: (n, 3) solid points in the world, metres, on a lattice of 32 along each
            axis of what is occupied of the box; n may be 0.
    """

    name: str
    posed: PosedField
    points: np.ndarray

    @staticmethod
    def of(name: str, posed: PosedField) -> Solid:
        """Find the solid points of an object as it is placed.

        Raises:
            InputError: no cell of the field is occupied.
        """
        field = posed.field
        box = field.upper - field.lower
        lower, upper = field.lower + box * field.occupancy.bounds
        size = upper - lower
        index = dr.arange(mi.UInt32, _CELLS**3)
        cells = index // _CELLS**2, index // _CELLS % _CELLS, index % _CELLS
        unit = (mi.Point3f(*map(mi.Float, cells)) + 0.5) / _CELLS
        at = mi.Point3f(*map(float, lower)) + unit * mi.Vector3f(*map(float, size))
        solid = np.argwhere(_is_solid(posed, at).reshape([_CELLS] * 3))
        local = lower + (solid + 0.5) / _CELLS * size
        return Solid(name, posed, posed.placed.apply(local))

    def is_solid(self, points: np.ndarray) -> np.ndarray:
        """Tell which points (n, 3) of the world are solid."""
        pose, field = self.posed.placed, self.posed.field
        local = pose.to_local(points)
        within = ((local >= field.lower) & (local <= field.upper)).all(1)
        return within & _is_solid(self.posed, upload_rows(mi.Point3f, local))

    @property
    def sampled(self) -> np.ndarray:
        """At most 4096 of the points, the lowest among them."""
        order = np.argsort(self.points[:, 2], kind="stable")
        lowest, others = np.split(order, [_MOST_POINTS // 8])
        step = -(-len(others) // (_MOST_POINTS - _MOST_POINTS // 8)) or 1
        return self.points[np.concatenate([lowest, others[::step]])]


def _is_solid(posed: PosedField, local: mi.Point3f) -> np.ndarray:
    field = posed.field
    density = field.density(local, mi.Bool(True)).numpy()
    return density * float(np.max(field.upper - field.lower)) >= 1


def lane_findings(
    solids: Sequence[Solid], route: Route, car_width_m: float, freedom: Freedom
) -> Iterator[str]:
    """Tell of objects in the way of a car in the middle of the lane.

    What is lower than 0.1 m may be driven over, what is higher than 2 m under.

    Args:
        solids: the objects.
        route: the lane's centre, from its first to its last point.
        car_width_m: metres.
        freedom: how far the attack may shift the objects along the world's axes and
            turn them about z.
    """
    half = car_width_m / 2
    for solid in solids:
        low, high = CAR_M
        if freedom.pose_rate is not None and "z" in freedom.axes:
            low, high = low - freedom.limit_m, high + freedom.limit_m
        z = solid.points[:, 2]
        points = solid.points[(z > CAR_M[0]) & (z < CAR_M[1])]
        nearest = _nearest(points[:, :2], route)
        if nearest[1] < half:
            at, distance, arc = nearest
            yield (
                f"{solid.name} stands on the lane: {arc:.1f} m along route "
                f"{route.name!r}, at {_coordinates(at)}, it is {distance:.2f} m from "
                f"the lane's centre, and the car needs {half:.2f} m to each side; move "
                "it aside"
            )
            continue
        if freedom.pose_rate is None:
            continue
        reached = _reached(
            solid.points[(z > low) & (z < high)], solid, route, freedom=freedom
        )
        if reached[1] < half:
            yield (
                f"{solid.name} may move onto the lane: attack.pose_limit_m and "
                f"pose_limit_deg let it come to {reached[1]:.2f} m from the lane's "
                f"centre, {reached[2]:.1f} m along route {route.name!r}, and the car "
                f"needs {half:.2f} m to each side; lower them, or move it aside"
            )


def _nearest(points: np.ndarray, route: Route) -> tuple[Any, float, float]:
    """Return the one of (n, 2) beside the route that is nearest, how far, and where.

    The distance is infinite where none is beside it.
    """
    if not len(points):
        return None, math.inf, 0.0
    projection = route.project_numpy(np.pad(points, ((0, 0), (0, 1))))
    distance = np.abs(projection.cross_track)
    if not route.closed:
        beside = (projection.arc_length >= 0) & (projection.arc_length <= route.length)
        distance = np.where(beside, distance, np.inf)
    i = int(distance.argmin())
    return points[i], float(distance[i]), float(projection.arc_length[i])


def _reached(
    points: np.ndarray, solid: Solid, route: Route, freedom: Freedom
) -> tuple[Any, float, float]:
    """Return as :func:`_nearest`, of where an attack may move the points (n, 3)."""
    if not len(points):
        return _nearest(points, route)
    x, y, *_, yaw = freedom.mask
    along_x, along_y = _steps(x * freedom.limit_m), _steps(y * freedom.limit_m)
    shifts = np.stack(np.meshgrid(along_x, along_y))
    origin = solid.posed.placed.translation
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ways = np.stack([np.cos(angles), np.sin(angles)])
    outline = points[np.unique((points[:, :2] @ ways).argmax(0))] - origin
    nearest = []
    for angle in yaw * freedom.limit_rad * np.linspace(-1, 1, 9):
        turned = outline @ Rotation.from_euler("z", angle).as_matrix().T + origin
        moved = turned[:, None, :2] + shifts.reshape(2, -1).T
        nearest.append(_nearest(moved.reshape(-1, 2), route))
    return min(nearest, key=lambda item: item[1])


def _steps(limit: float) -> np.ndarray:
    return np.linspace(-limit, limit, 2 * min(math.ceil(limit / 0.25), 20) + 1)


def meeting_findings(solids: Sequence[Solid]) -> Iterator[str]:
    """Tell of objects that stand in one another."""
    for one, other in combinations(solids, 2):
        shares = []
        for a, b in ((one, other), (other, one)):
            inside = b.is_solid(a.sampled) if len(a.points) else np.zeros(1, bool)
            shares.append(inside.mean())
        if max(shares) > SHARE:
            yield (
                f"{one.name} and {other.name} stand in one another: "
                f"{100 * max(shares):.0f} % of one is within the other; move them apart"
            )


def scene_findings(
    solids: Sequence[Solid], route: Route, scene: Any, name: str
) -> Iterator[str]:
    """Tell of objects in the walls or the ground of a scene, or in the air.

    A point is in a wall if the lines from five points over the lane to it all go
    through as many more surfaces from front to back than from back to front.

    Args:
        solids: the objects.
        route: runs in the open.
        scene: `mi.Scene`, z up.
        name: of its file.
    """
    for solid in solids:
        if not len(solid.points):
            continue
        points = solid.sampled
        distance = _distances(scene, points)
        inside = _is_inside(scene, points, route)
        depth = np.where(inside, distance.min(1), 0.0)
        if inside.mean() > SHARE and depth.max() > DEPTH_M:
            yield _buried(solid.name, name, points, distance=distance, depth=depth)
        elif not inside.any() and distance.min() > GAP_M:
            lowest = points[:, 2] < points[:, 2].min() + GAP_M / 4
            gap = distance[lowest, -1].min()
            high = f"{gap:.2f} m above what is beneath it"
            yield (
                f"{solid.name} is in the air of {name}: it touches nothing, and hangs "
                f"{high if np.isfinite(gap) else 'above nothing'}; put it on the ground"
            )


def _buried(
    solid: str, scene: str, points: np.ndarray, distance: np.ndarray, depth: np.ndarray
) -> str:
    deepest = int(depth.argmax())
    up = int(distance[deepest].argmin()) == 2
    what, remedy = ("the ground", "raise it") if up else ("a wall", "move it")
    return (
        f"{solid} reaches {depth[deepest]:.2f} m into {what} of {scene}, at "
        f"{_coordinates(points[deepest])}, where its texture is not seen; {remedy}"
    )


def _is_inside(scene: Any, points: np.ndarray, route: Route) -> np.ndarray:
    """Tell which points (n, 3) are within a surface, or beneath it."""
    arc = route.project_numpy([*points.mean(0)[:2], 0.0]).arc_length[0]
    arcs = arc + np.array(_AHEAD_M)
    if not route.closed:
        arcs = np.clip(arcs, 0, route.length)
    counts = []
    for x, y, _ in route.pose_at(arcs):
        counts.append(_entered(scene, np.array([x, y, _OPEN_HEIGHT_M]), points))
    return (counts[0] != 0) & np.all(np.diff(counts, axis=0) == 0, axis=0)


def _entered(scene: Any, start: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Count the surfaces that lines (n,) enter, less those that they leave."""
    line = points - start
    length = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    unit = line / length[:, None]
    direction = upload_rows(mi.Vector3f, unit)
    begin, count = np.zeros(len(points)), np.zeros(len(points), int)
    for _ in range(_MOST_SURFACES):
        at = upload_rows(mi.Point3f, start + begin[:, None] * unit)
        hit = scene.ray_intersect(mi.Ray3f(at, direction))
        t = begin + hit.t.numpy()
        met = t < length
        if not met.any():
            break
        facing = (hit.n.numpy().T * unit).sum(1)
        count += np.where(met, -np.sign(facing).astype(int), 0)
        begin = np.where(met, t + 1e-4, begin)
    return count


def _distances(scene: Any, points: np.ndarray) -> np.ndarray:
    """Measure how far the next surface is along six axes, (n, 6), metres."""
    origins = np.repeat(points, 6, axis=0)
    directions = np.tile(_AXES, (len(points), 1))
    ray = mi.Ray3f(
        upload_rows(mi.Point3f, origins), upload_rows(mi.Vector3f, directions)
    )
    hit = scene.ray_intersect_preliminary(ray, coherent=False)
    return hit.t.numpy().reshape(-1, 6)


def _coordinates(point: np.ndarray) -> str:
    return f"({', '.join(f'{x:.1f}' for x in point.round(1) + 0)}) m"


def solids_of(objects: Mapping[str, PosedField]) -> list[Solid]:
    """Return objects, by id, as points."""
    return [Solid.of(name, posed) for name, posed in objects.items()]
