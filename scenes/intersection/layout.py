"""Plan of the T-intersection: kerbs, distances to them, and the routes.

The main road runs along x, the side road leaves it to the south. Lengths in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..place import route_entry

LANE_WIDTH = 3.5
ROAD_END = 45.0
KERB_RADIUS = 5.0
KERB_HEIGHT = 0.12
PAVEMENT_WIDTH = 2.5
ROUTE_SPACING = 0.5


def road_depth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the signed distance to the nearest kerb, positive on the road.

    Args:
        x: world coordinates, metres, of any shape.
        y: likewise, of the same shape.
    """
    x = np.abs(x)
    centre = LANE_WIDTH + KERB_RADIUS
    north = LANE_WIDTH - y
    corner = np.hypot(x - centre, y + centre) - KERB_RADIUS
    # South of the arcs only the side road's kerb counts, beside them the main road's.
    south = np.where(
        (x < centre) & (y > -centre),
        corner,
        np.where(y > -centre, y + LANE_WIDTH, LANE_WIDTH - x),
    )
    return np.minimum(north, south)


def corner_kerb(side: int, steps: int = 12) -> np.ndarray:
    """Return the kerb line (n, 2) of the south-west (-1) or south-east (+1) corner.

    The line starts at the main road's end and stops at the side road's end.
    """
    centre = LANE_WIDTH + KERB_RADIUS
    angle = np.linspace(np.pi / 2, 0.0, steps + 1)
    arc = np.stack(
        [-centre + KERB_RADIUS * np.cos(angle), -centre + KERB_RADIUS * np.sin(angle)],
        axis=1,
    )
    line = np.concatenate([[[-ROAD_END, -LANE_WIDTH]], arc, [[-LANE_WIDTH, -ROAD_END]]])
    return line * np.array([-side, 1.0])


def _turn(start, corner, end, radius: float) -> np.ndarray:
    """Sample two straights joined by an arc at equal steps of arc length.

    Args:
        start: (2,), metres.
        corner: (2,), where the straights would meet at 90 degrees.
        end: (2,), metres.
        radius: of the arc, metres.
    """
    start, corner, end = (np.asarray(p, dtype=np.float64) for p in (start, corner, end))
    before = (corner - start) / np.linalg.norm(corner - start)
    after = (end - corner) / np.linalg.norm(end - corner)
    first = np.linalg.norm(corner - start) - radius
    arc = 0.5 * np.pi * radius
    last = np.linalg.norm(end - corner) - radius
    centre = corner - radius * before + radius * after
    s = (
        ROUTE_SPACING
        * np.arange(int((first + arc + last) / ROUTE_SPACING) + 1)[:, None]
    )
    angle = np.clip((s - first) / radius, 0.0, 0.5 * np.pi)
    curve = centre + radius * (np.sin(angle) * before - np.cos(angle) * after)
    lead = np.minimum(s - first, 0.0) * before
    return curve + lead + np.maximum(s - first - arc, 0.0) * after


def routes() -> dict[str, dict[str, Any]]:
    """Return the three routes as routes.json holds them."""
    half = LANE_WIDTH / 2
    x = np.arange(-25.0, 35.0 + ROUTE_SPACING / 2, ROUTE_SPACING)
    points = {
        "straight": np.stack([x, np.full_like(x, -half)], axis=1),
        "right": _turn(
            (-22.0, -half), (-half, -half), (-half, -30.0), KERB_RADIUS + half
        ),
        "left": _turn((half, -24.0), (half, half), (-30.0, half), 9.0),
    }
    return {
        name: route_entry(value, goal=goal, lane_width=LANE_WIDTH, speed=5.0)
        for goal, (name, value) in enumerate(points.items())
    }
