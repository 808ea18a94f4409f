"""Plan of the country road: its centre line, distances to it, and the routes.

The straight between the two curves runs through the origin along +x, where the arc
length is `ORIGIN_S`. Lengths in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import KDTree

from ..place import route_entry

LANE_WIDTH = 3.25
SPEED_MS = 5.0
ROUTE_SPACING = 0.5
#: Arc lengths where the routes begin and end; the road goes on beyond both.
ROUTE_FROM, ROUTE_TO = 30.0, 124.0
ORIGIN_S = 81.0
#: Arc length and curvature, 1/m, positive to the left, linear between these knots:
#: a left curve of radius 30 m, and a right curve of 16 m.
KNOTS = np.array(
    [
        (0.0, -1 / 40), (16.0, -1 / 40), (24.0, 0.0), (40.0, 0.0),
        (48.0, 1 / 30), (68.0, 1 / 30), (76.0, 0.0), (86.0, 0.0),
        (92.0, -1 / 16), (106.0, -1 / 16), (112.0, 0.0), (124.0, 0.0),
        (130.0, 1 / 30), (150.0, 1 / 30),
    ]
)  # fmt: skip
LENGTH = float(KNOTS[-1, 0])
_STEP = 0.01


def _line() -> tuple[np.ndarray, np.ndarray]:
    """Integrate the curvature: points (n, 2) and headings (n,) at steps of `_STEP`."""
    count = round(LENGTH / _STEP) + 1
    middle = _STEP * (np.arange(count - 1) + 0.5)
    turn = _STEP * np.interp(middle, *KNOTS.T)
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    chord = 0.5 * (heading[1:] + heading[:-1])
    steps = _STEP * np.stack([np.cos(chord), np.sin(chord)], axis=1)
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    origin = round(ORIGIN_S / _STEP)
    c, s = np.cos(heading[origin]), np.sin(heading[origin])
    points = (points - points[origin]) @ np.array([[c, -s], [s, c]])
    return points, heading - heading[origin]


_POINTS, _HEADINGS = _line()
#: Of each so many points one, among which the nearest is looked for.
_EACH = 25
_TREE = KDTree(_POINTS[::_EACH])


def at(s: np.ndarray, offset: np.ndarray | float = 0.0) -> np.ndarray:
    """Return points (n, 2) at arc lengths (n,) of the centre line.

    Args:
        s: metres, within the road's length.
        offset: to the left of the centre line, metres, (n,) or one number.
    """
    grid = _STEP * np.arange(len(_POINTS))
    heading = np.interp(s, grid, _HEADINGS)
    middle = np.stack([np.interp(s, grid, _POINTS[:, k]) for k in range(2)], axis=-1)
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    return middle + np.asarray(offset)[..., None] * left


def heading_at(s: float) -> float:
    """Return the heading of the centre line at an arc length, radians."""
    return float(np.interp(s, _STEP * np.arange(len(_POINTS)), _HEADINGS))


def road_distance(places: np.ndarray) -> np.ndarray:
    """Return the distance (...) to the centre line, metres.

    Args:
        places: (..., 2), world coordinates, metres.

    Returns:
        The distance d to the tangent at the nearest of the points that are 0.25 m
        apart. In a curve of radius R, it is wrong by at most (1 + d / R) 0.125^2 / 2 R.
        Beyond the ends of the road, the distance to the end.
    """
    nearest, index = _TREE.query(places)
    heading = _HEADINGS[::_EACH][index]
    off = places - _POINTS[::_EACH][index]
    along = np.cos(heading) * off[..., 0] + np.sin(heading) * off[..., 1]
    across = np.cos(heading) * off[..., 1] - np.sin(heading) * off[..., 0]
    last = len(_TREE.data) - 1
    beyond = ((index == 0) & (along < 0)) | ((index == last) & (along > 0))
    return np.where(beyond, nearest, np.abs(across))


def _lane(offset: float) -> np.ndarray:
    """Sample a lane's centre, offset to the left, at equal steps of arc length."""
    dense = at(np.arange(ROUTE_FROM, ROUTE_TO + 0.5 * _STEP, _STEP), offset)
    length = np.linalg.norm(np.diff(dense, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(length)])
    s = ROUTE_SPACING * np.arange(int(along[-1] / ROUTE_SPACING) + 1)
    return np.stack([np.interp(s, along, dense[:, k]) for k in range(2)], axis=1)


def routes() -> dict[str, dict[str, Any]]:
    """Return both directions as routes.json holds them; traffic keeps to the right."""
    half = LANE_WIDTH / 2
    lanes = {"out": _lane(-half), "back": _lane(half)[::-1]}
    return {
        name: route_entry(points, goal=0, lane_width=LANE_WIDTH, speed=SPEED_MS)
        for name, points in lanes.items()
    }
