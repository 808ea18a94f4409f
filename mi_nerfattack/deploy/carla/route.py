"""Routes along the lanes of a town of CARLA."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.carla.cameras import read_pose
from mi_nerfattack.deploy.carla.conventions import (
    body_from_carla,
    heading_from_carla,
    point_to_carla,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.route.route import Route

#: Change of heading at a junction that each turn comes nearest to, radians.
TURNS = {"straight": 0.0, "left": math.pi / 2, "right": -math.pi / 2}
_LOOK_AHEAD_M = 25.0  # what is ahead of a fork, to tell its branches apart
_MAX_POINTS = 50_000


def route_from_town(
    town_map: Any,
    api: Any,
    start: Sequence[float],
    *,
    end: Sequence[float] | None = None,
    distance_m: float | None = None,
    turns: Sequence[str] = (),
    spacing_m: float = 1.0,
    name: str = "town",
    goal: int = 0,
    speed_ms: float = 5.0,
) -> Route:
    """Make a route of the centres of lanes, in the direction of traffic.

    Lanes are never changed.

    Args:
        town_map: `carla.Map`; `carla.Map(name, opendrive)` needs no server.
        api: the module `carla`.
        start: (2,) or (3,), metres, our axes; the nearest lane counts.
        end: the same of the end, which the shortest way leads to; or
        distance_m: length of the route, metres.
        turns: at the forks of a route by distance, "straight", "left" or "right" each;
            "straight" at those that follow.
        spacing_m: between points, metres.
        name: of the route.
        goal: of the route.
        speed_ms: of the route.

    Raises:
        InputError: both or none of end and distance, no way to the end, a road that
            ends before the distance, an unknown turn, or one without a fork.
    """
    if (end is None) == (distance_m is None):
        raise InputError("route_from_town: give either end or distance_m")
    if end is not None and turns:
        raise InputError(
            f"turns: {', '.join(turns)}; those of a route by distance_m: leave them "
            "out of one to an end"
        )
    if not 0.1 <= spacing_m <= 10:
        raise InputError(f"route_from_town: spacing_m {spacing_m}; 0.1 to 10 m")
    first = _nearest(town_map, api, start)
    if distance_m is not None:
        waypoints = _by_distance(first, distance_m, turns, spacing_m)
    else:
        assert end is not None
        waypoints = _shortest(first, _nearest(town_map, api, end), spacing_m)
    points = np.array([_position(waypoint)[:2] for waypoint in waypoints])
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3
    points = points[np.concatenate([[True], moved])]
    return Route(name, goal, points, float(first.lane_width), speed_ms)


def _nearest(town_map: Any, api: Any, point: Sequence[float]) -> Any:
    values = np.asarray(point, np.float64)
    if values.shape not in ((2,), (3,)) or not np.isfinite(values).all():
        raise InputError(
            f"route_from_town: point {values.tolist()}; two or three finite numbers, "
            "metres"
        )
    values = point_to_carla(np.append(values, 0.0)[:3]).tolist()
    waypoint = town_map.get_waypoint(api.Location(*values))
    if waypoint is None:
        raise InputError(f"route_from_town: no lane near {list(point)}")
    return waypoint


def _by_distance(
    first: Any, distance_m: float, turns: Sequence[str], spacing_m: float
) -> list[Any]:
    for turn in turns:
        if turn not in TURNS:
            raise InputError(f"turn: {turn!r}; one of {', '.join(TURNS)}")
    count = math.ceil(distance_m / spacing_m)
    if not 1 <= count <= _MAX_POINTS:
        raise InputError(
            f"route_from_town: distance_m {distance_m}; more than 0 and at most "
            f"{_MAX_POINTS * spacing_m:g} m"
        )
    found, rest = [first], list(turns)
    for _ in range(count):
        choices = found[-1].next(spacing_m)
        if not choices:
            raise InputError(
                f"route_from_town: the lane ends after {spacing_m * (len(found) - 1):g}"
                f" of {distance_m:g} m; start elsewhere or take a shorter distance"
            )
        if len(choices) > 1:
            turn = rest.pop(0) if rest else "straight"
            found.append(_branch(found[-1], choices, TURNS[turn]))
        else:
            found.append(choices[0])
    if rest:
        raise InputError(
            f"turns: {', '.join(rest)}; the route has no fork for it within "
            f"{distance_m:g} m: take a longer distance, or start elsewhere"
        )
    return found


def _branch(here: Any, choices: Sequence[Any], turn: float) -> Any:
    """Choose the branch whose heading after the junction is nearest to a turn."""
    before = _heading(here)

    def miss(choice: Any) -> float:
        ahead = choice.next(_LOOK_AHEAD_M)
        after = _heading(ahead[0] if ahead else choice)
        return abs(math.remainder(after - before - turn, 2 * math.pi))

    return min(choices, key=miss)


def _shortest(first: Any, last: Any, spacing_m: float) -> list[Any]:
    """Search from waypoint to waypoint (A*)."""
    target = _position(last)
    order = itertools.count()
    queue: list[tuple[float, int, float, Any, Any]] = []
    heapq.heappush(queue, (0.0, next(order), 0.0, first, None))
    seen: set[tuple[int, ...]] = set()
    while queue and len(seen) <= _MAX_POINTS:
        _, _, driven, waypoint, trail = heapq.heappop(queue)
        key = _key(waypoint, spacing_m)
        if key in seen:
            continue
        seen.add(key)
        trail = (waypoint, trail)
        if driven > 0 and _arrived(waypoint, last, spacing_m):
            return _unroll(trail)
        for choice in waypoint.next(spacing_m):
            way = driven + spacing_m
            bound = way + float(np.linalg.norm(_position(choice) - target))
            heapq.heappush(queue, (bound, next(order), way, choice, trail))
    raise InputError(
        f"route_from_town: no way from {_position(first)[:2].round(2).tolist()} to "
        f"{target[:2].round(2).tolist()} without changing lanes; take another end"
    )


def _arrived(waypoint: Any, last: Any, spacing_m: float) -> bool:
    same_lane = (waypoint.road_id, waypoint.lane_id) == (last.road_id, last.lane_id)
    gap = np.linalg.norm(_position(waypoint) - _position(last))
    return same_lane and float(gap) <= 0.75 * spacing_m


def _unroll(trail: Any) -> list[Any]:
    found = []
    while trail is not None:
        waypoint, trail = trail
        found.append(waypoint)
    return found[::-1]


def _key(waypoint: Any, spacing_m: float) -> tuple[int, ...]:
    # by half a spacing: rounding takes no two neighbours of a lane for one
    station = round(2 * waypoint.s / spacing_m)
    return waypoint.road_id, waypoint.section_id, waypoint.lane_id, station


def _position(waypoint: Any) -> np.ndarray:
    return body_from_carla(read_pose(waypoint.transform))[:3, 3]


def _heading(waypoint: Any) -> float:
    return heading_from_carla(waypoint.transform.rotation.yaw)
