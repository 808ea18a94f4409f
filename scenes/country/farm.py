"""What people built beside the road: a house with its barn, fences, posts, gates."""

from __future__ import annotations

import numpy as np

from ..atlas import Facade
from ..scenery import Building, Scenery
from .ground import YARD, YARD_HEIGHT, height
from .layout import LENGTH, at, heading_at

HOUSE = Building(
    (YARD[0] - 6, YARD[0] + 5, YARD[1] - 1, YARD[1] + 7),
    5.2,
    Facade((0.91, 0.87, 0.77), (0.55, 0.30, 0.22), 2, 5),
    "tile",
    gable=True,
)
BARN = Building(
    (YARD[0] + 7, YARD[0] + 13, YARD[1] - 4, YARD[1] + 5),
    3.8,
    Facade((0.47, 0.30, 0.22), (0.36, 0.24, 0.18), 1, 3),
    "slate",
    gable=True,
)
#: Fences: arc lengths from and to, offset from the centre line.
FENCES = [(56.0, 94.0, -8.0), (22.0, 52.0, 8.0), (107.0, 127.0, 8.5)]
_PANEL = 2.5
#: Arc lengths of the marker posts, and how far off the centre line they stand.
MARKERS, MARKER_OFFSET = np.arange(10.0, 146.0, 12.0), 4.5


def _fence(
    scenery: Scenery, start: float, end: float, offset: float, seed: int
) -> None:
    """Append posts with two rails along the road."""
    s = np.linspace(start, end, round((end - start) / _PANEL) + 1)
    posts = at(s, offset)
    foot = height(posts, seed) - 0.1
    for (x, y), z in zip(posts, foot, strict=True):
        scenery.box((x, y, z), (0.13, 0.13, 1.3), "wood")
    for one, two, z in zip(posts, posts[1:], foot, strict=False):
        step = two - one
        size = (float(np.linalg.norm(step)), 0.06, 0.13)
        for rise in (0.6, 1.05):
            place = (*(0.5 * (one + two)), z + rise)
            scenery.box(place, size, "wood", float(np.arctan2(step[1], step[0])))


def _marker(scenery: Scenery, s: float, offset: float) -> None:
    """Append a white post with a dark band."""
    (x, y), angle = at(np.array([s]), offset)[0], heading_at(s)
    for z, size, colour in (
        (-0.1, (0.15, 0.17, 0.75), "white"),
        (0.65, (0.16, 0.18, 0.2), "dark"),
        (0.85, (0.15, 0.17, 0.12), "white"),
    ):
        scenery.box((x, y, z), size, colour, angle)


def _gate(scenery: Scenery, s: float) -> None:
    """Append a gate of five bars across the road."""
    (x, y), angle = at(np.array([s]))[0], heading_at(s) + np.pi / 2
    for z in (0.25, 0.5, 0.75, 1.0, 1.25):
        scenery.box((x, y, z), (7.4, 0.07, 0.1), "white", angle)
    for side in (-3.7, 3.7):
        post = np.array([x + side * np.cos(angle), y + side * np.sin(angle), -0.1])
        scenery.box(post, (0.25, 0.25, 1.7), "trunk", angle)


def furnish(scenery: Scenery, seed: int) -> None:
    """Append everything that people built.

    Args:
        scenery: with the facades of the house and the barn in its atlas.
        seed: of the ground's heights.
    """
    for index, item in enumerate((HOUSE, BARN)):
        scenery.building(index, item, YARD_HEIGHT)
    x, y = YARD
    ridge = YARD_HEIGHT + HOUSE.height
    scenery.box((x + 2.5, y + 4.0, ridge), (0.9, 0.9, 3.3), "brick")
    scenery.box((x - 1, y - 1.6, YARD_HEIGHT), (2.6, 1.2, 0.3), "concrete")
    scenery.box((x - 1, y - 1.7, YARD_HEIGHT + 2.5), (3.0, 1.6, 0.12), "slate")
    for side in (-1.3, 1.3):
        scenery.box((x - 1 + side, y - 2.3, YARD_HEIGHT), (0.14, 0.14, 2.5), "white")
    scenery.box((x + 10, y - 4.06, 0), (3.0, 0.1, 3.0), "wood")
    for start, end, offset in FENCES:
        _fence(scenery, start, end, offset, seed)
    for k, s in enumerate(MARKERS):
        _marker(scenery, float(s), MARKER_OFFSET * (1 if k % 2 else -1))
    for s in (1.0, LENGTH - 1.0):
        _gate(scenery, s)
    for cx, cy, face in (
        (-26, -20, 0.4),
        (-33, -13, 1.3),
        (-40, -24, 2.2),
        (8, -24, 0),
    ):
        z = float(height(np.array([cx, cy]), seed))
        scenery.disc((cx, cy, z + 0.65), 0.75, 1.2, face, "wood")
    for k, colour in enumerate(("red", "wood")):
        scenery.box((x - 8 + 2 * k, y - 2, 0), (1.2, 0.9, 1.2), colour)
