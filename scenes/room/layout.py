"""Plan of the room: walls, and the square track marked by green tape.

The room's middle is the origin, x runs along its longer walls. Lengths in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..place import route_entry

LENGTH, WIDTH, HEIGHT = 6.0, 5.0, 2.7
TRACK_HALF = 1.6
CORNER_RADIUS = 1.1
TAPE_WIDTH = 0.05
LANE_WIDTH = 0.6
SPEED_MS = 1.0
ROUTE_SPACING = 0.1


def track_distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the distance to the track's centre, positive outside of the loop.

    Args:
        x: metres, of any shape.
        y: likewise, of the same shape.
    """
    straight = TRACK_HALF - CORNER_RADIUS
    across, along = np.abs(x) - straight, np.abs(y) - straight
    corner = np.hypot(np.maximum(across, 0), np.maximum(along, 0))
    return corner + np.minimum(np.maximum(across, along), 0) - CORNER_RADIUS


def track() -> np.ndarray:
    """Sample the loop at equal steps of arc length, counter-clockwise, (n, 2).

    It begins where the southern straight does; the first point is not repeated.
    """
    straight = 2 * (TRACK_HALF - CORNER_RADIUS)
    side = straight + 0.5 * np.pi * CORNER_RADIUS
    count = round(4 * side / ROUTE_SPACING)
    s = np.arange(count) * 4 * side / count
    quarter = np.floor(s / side).astype(int)
    s = s - quarter * side
    angle = np.maximum(s - straight, 0) / CORNER_RADIUS
    x = np.minimum(s, straight) - 0.5 * straight + CORNER_RADIUS * np.sin(angle)
    y = CORNER_RADIUS * (1 - np.cos(angle)) - TRACK_HALF
    turn = 0.5 * np.pi * quarter
    cos, sin = np.cos(turn), np.sin(turn)
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)


def routes() -> dict[str, dict[str, Any]]:
    """Return the loop as routes.json holds it."""
    loop = route_entry(track(), goal=0, lane_width=LANE_WIDTH, speed=SPEED_MS)
    points = loop.pop("points_m")
    return {"square": loop | {"closed": True, "points_m": points}}
