"""Routes of the CARLA leaderboard, along the lanes of a town."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mi_nerfattack.deploy.carla.cameras import read_pose
from mi_nerfattack.deploy.carla.conventions import (
    body_from_carla,
    point_from_carla,
    point_to_carla,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.vehicle.route.route import Route

_SPACING_M = 1.0  # between the points of a route
_OFF_LANE_M = 5.0  # largest distance of a position from the lane that it is on
_MAX_POINTS = 50_000
_MAX_BYTES = 1 << 24


@dataclass(frozen=True, eq=False)
class TownRoute:
    """A route of a leaderboard's file.

    Args:
        name: the attribute `id`.
        town: the attribute `town`.
        points: (n, 3), positions to drive past, metres, our axes; n >= 2.
    """

    name: str
    town: str
    points: np.ndarray


def read_leaderboard(path: Path) -> list[TownRoute]:
    """Read a leaderboard's file: ``<route id= town=>`` with positions or waypoints.

    Version 1 has ``<waypoint x= y= z=>``, version 2 has ``<position>`` in
    ``<waypoints>``. Scenarios and weathers are not read.

    Raises:
        InputError: no XML, no route, or a route without an id, a town or two positions.
    """
    try:
        root = ElementTree.fromstring(files.read_bytes(path, _MAX_BYTES))
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: not XML ({error})") from error
    routes: dict[str, TownRoute] = {}
    for element in root.iter("route"):
        name, town = element.get("id"), element.get("town") or element.get("map")
        where = f"{path}: route {name!r}"
        if not name or not town or name in routes:
            raise InputError(f"{where}: needs an id of its own, and a town")
        items = [*element.findall("waypoints/position"), *element.findall("waypoint")]
        try:
            points = np.array([[float(i.attrib[k]) for k in "xyz"] for i in items])
        except (KeyError, ValueError) as error:
            raise InputError(f"{where}: a position without x, y, z: {error}") from error
        if len(points) < 2 or not np.isfinite(points).all():
            raise InputError(f"{where}: needs two finite positions or more")
        routes[name] = TownRoute(name, town, point_from_carla(points))
    if not routes:
        raise InputError(f"{path}: no <route>; give routes of the CARLA leaderboard")
    return list(routes.values())


def town_routes(
    path: Path,
    town_map: Any,
    api: Any,
    names: Sequence[str] = (),
    goal: int = 0,
    speed_ms: float = 5.0,
) -> list[Route]:
    """Return the routes of a leaderboard's file that lie in a town.

    A route follows the centres of lanes in the direction of traffic, from each position
    to the next, and never changes lanes.

    Args:
        path: XML.
        town_map: `carla.Map`; `carla.Map(name, opendrive)` needs no server.
        api: the module `carla`.
        names: ids of routes; all of the town by default.
        goal: of the routes.
        speed_ms: of the routes.

    Raises:
        InputError: none of the routes is in the town, a name is unknown, or a position
            lies off all lanes or cannot be reached along lanes.
    """
    town = town_map.name.split("/")[-1]
    every = read_leaderboard(path)
    routes = {route.name: route for route in every if route.town == town}
    if not routes:
        towns = ", ".join(sorted({route.town for route in every}))
        raise InputError(f"{path}: no route in {town!r}; its routes are in {towns}")
    unknown = [name for name in names if name not in routes]
    if unknown:
        raise InputError(
            f"{path}: no route {unknown[0]!r} in {town!r}; it has {', '.join(routes)}"
        )
    chosen = [routes[name] for name in names or routes]
    return [
        _along_lanes(path, town_map, api, route=each, goal=goal, speed_ms=speed_ms)
        for each in chosen
    ]


def _along_lanes(
    path: Path, town_map: Any, api: Any, route: TownRoute, goal: int, speed_ms: float
) -> Route:
    where, trail = f"{path}: route {route.name!r}", []
    for index, point in enumerate(route.points):
        place = f"{where}: position {index}, {point[:2].round(2).tolist()}"
        waypoint = town_map.get_waypoint(api.Location(*point_to_carla(point).tolist()))
        away = np.inf
        if waypoint is not None:
            away = float(np.linalg.norm(_position(waypoint)[:2] - point[:2]))
        if away > _OFF_LANE_M:
            raise InputError(
                f"{place}: {away:.0f} m from the nearest lane; is {route.town} the map?"
            )
        if not trail:
            trail.append(waypoint)
        elif not _arrived(trail[-1], waypoint, _SPACING_M):
            trail += _shortest(place, trail[-1], waypoint, spacing_m=_SPACING_M)[1:]
    points = np.array([_position(waypoint)[:2] for waypoint in trail])
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3
    points = points[np.concatenate([[True], moved])]
    return Route(
        route.name,
        goal,
        points,
        lane_width_m=float(trail[0].lane_width),
        speed_ms=speed_ms,
    )


def _shortest(place: str, first: Any, last: Any, spacing_m: float) -> list[Any]:
    """Search from waypoint to waypoint (A*); `place` is for messages."""
    target = _position(last)
    order = itertools.count()
    queue: list[tuple[float, int, float, Any, Any]] = []
    heapq.heappush(queue, (0.0, next(order), 0.0, first, None))
    visited: set[tuple[int, ...]] = set()
    while queue and len(visited) <= _MAX_POINTS:
        _, _, driven, waypoint, trail = heapq.heappop(queue)
        key = _key(waypoint, spacing_m)
        if key in visited:
            continue
        visited.add(key)
        trail = (waypoint, trail)
        if driven > 0 and _arrived(waypoint, last, spacing_m):
            return _unroll(trail)
        for choice in waypoint.next(spacing_m):
            way = driven + spacing_m
            bound = way + float(np.linalg.norm(_position(choice) - target))
            heapq.heappush(queue, (bound, next(order), way, choice, trail))
    raise InputError(
        f"{place}: no lane leads there from {_position(first)[:2].round(2).tolist()}; "
        "a route never changes lanes: choose other routes by name"
    )


def _arrived(waypoint: Any, last: Any, spacing_m: float) -> bool:
    """Tell whether no step along the lane comes nearer to the last position."""
    gap = _distance(waypoint, last)
    if not _same_lane(waypoint, last) or gap > 1.001 * spacing_m:
        return False
    ahead = [way for way in waypoint.next(spacing_m) if _same_lane(way, last)]
    return all(_distance(way, last) >= gap for way in ahead)


def _same_lane(waypoint: Any, other: Any) -> bool:
    return (waypoint.road_id, waypoint.lane_id) == (other.road_id, other.lane_id)


def _distance(waypoint: Any, other: Any) -> float:
    return float(np.linalg.norm(_position(waypoint) - _position(other)))


def _unroll(trail: Any) -> list[Any]:
    waypoints = []
    while trail is not None:
        waypoint, trail = trail
        waypoints.append(waypoint)
    return waypoints[::-1]


def _key(waypoint: Any, spacing_m: float) -> tuple[int, ...]:
    # by half a spacing: rounding takes no two neighbours of a lane for one
    station = round(2 * waypoint.s / spacing_m)
    return waypoint.road_id, waypoint.section_id, waypoint.lane_id, station


def _position(waypoint: Any) -> np.ndarray:
    return body_from_carla(read_pose(waypoint.transform))[:3, 3]
