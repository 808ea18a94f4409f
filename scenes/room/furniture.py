"""Boxes, tables, shelves and plants that stand in the room, metres."""

from __future__ import annotations

from ..mesh import MeshBuilder
from ..scenery import Scenery

# middle of the foot, size, colour, angle
_BOXES = [
    ((-0.25, 0.15, 0), (0.5, 0.4, 0.35), "wood", 0.3),
    ((-0.20, 0.12, 0.35), (0.32, 0.3, 0.25), "orange", 0.7),
    ((0.35, -0.3, 0), (0.3, 0.3, 0.5), "blue", -0.2),
    ((2.6, -2.15, 0), (0.6, 0.45, 0.4), "wood", 0.1),
    ((2.65, -2.15, 0.4), (0.4, 0.35, 0.3), "yellow", 0.35),
    ((-2.65, 2.15, 0), (0.5, 0.5, 0.6), "purple", 0.0),
    ((-2.6, 1.4, 0), (0.45, 0.4, 0.3), "wood", -0.3),
    ((1.2, 2.3, 0), (0.35, 0.25, 0.45), "red", 0.0),
    ((-1.0, -2.3, 0), (0.5, 0.25, 0.3), "cyan", 0.0),
    ((0.6, -2.32, 0), (0.3, 0.22, 0.55), "green", 0.0),
    ((2.7, 0.9, 0), (0.3, 0.3, 0.35), "pink", 0.2),
]
_SHELVES = [((0.0, 2.34, 0), 1.1, 1.5, "wood"), ((-2.2, -2.34, 0), 0.9, 1.1, "white")]
_TABLES = [((2.62, -0.6, 0), (0.6, 1.4, 0.72)), ((-2.65, -0.4, 0), (0.55, 1.2, 0.6))]
_PLANTS = [(2.6, 2.1, 0.34, "crown_1"), (-2.65, -2.1, 0.28, "crown_3")]


def _shelf(room: Scenery, foot, width: float, height: float, colour: str) -> None:
    """Append an open shelf along a wall with coloured boxes in it."""
    x, y, _ = foot
    for side in (-1, 1):
        room.box((x + side * width / 2, y, 0), (0.04, 0.28, height), colour)
    fill = ("red", "blue", "yellow", "green", "dark", "orange")
    levels = 4
    for k in range(levels):
        z = 0.05 + k * (height - 0.1) / (levels - 1)
        room.box((x, y, z), (width, 0.28, 0.04), colour)
        if k < levels - 1:
            for i in range(3):
                place = (x + (i - 1) * width / 3.3, y, z + 0.04)
                room.box(place, (0.2, 0.2, 0.16 + 0.03 * i), fill[(k + 2 * i) % 6])


def _table(room: Scenery, foot, size) -> None:
    """Append a table on four legs."""
    (x, y, _), (a, b, height) = foot, size
    room.box((x, y, height - 0.05), (a, b, 0.05), "white")
    for i in (-1, 1):
        for j in (-1, 1):
            leg = (x + i * (a / 2 - 0.05), y + j * (b / 2 - 0.05), 0)
            room.box(leg, (0.05, 0.05, height - 0.05), "pole")


def furniture(seed: int) -> MeshBuilder:
    """Return everything that stands in the room as one mesh of plain colours."""
    room = Scenery(seed, 0)
    for foot, size, colour, angle in _BOXES:
        room.box(foot, size, colour, angle)
    for foot, width, height, colour in _SHELVES:
        _shelf(room, foot, width, height, colour)
    for foot, size in _TABLES:
        _table(room, foot, size)
    for x, y, scale, crown in _PLANTS:
        room.solid((x, y, 0), [0.13, 0.17, 0.17], [0.0, 0.28, 0.29], "brick", 12)
        room.tree(x, y, scale, crown)
    return room.mesh
