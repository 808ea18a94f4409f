"""Where hedges, trees, lamps, signs and other street furniture stand, metres."""

from __future__ import annotations

import numpy as np

from ..scenery import Scenery

_CROWNS = ("crown_1", "crown_2", "crown_3")

TREES = [
    (-41, 7.6), (-33.5, 7.8), (-19.5, 8.4), (-9.5, 8.6), (10.8, 8.2), (23.5, 8.4),
    (37.2, 8.2), (-47.5, -8), (-30, -8.6), (-28.5, -15), (-9.2, -10), (9.4, -9.6),
    (25.5, -9), (25, -17), (43.5, -8.4), (-8.3, -20), (-8.4, -33), (8.6, -23.5),
    (8.6, -36), (-8.6, -45.5), (9.5, -46.5), (-38, -28), (-28, -34), (-43, -38),
    (30, -28), (38, -36), (27, -42), (45, -24), (-47, -16),
]  # fmt: skip
LAMPS = [
    (-36, 5.2, (0, -1.6)), (-3.2, 6.0, (0, -1.6)), (27, 5.2, (0, -1.6)),
    (-22, -5.2, (0, 1.6)), (14, -5.2, (0, 1.6)), (40, -5.2, (0, 1.6)),
    (-5.2, -24, (1.6, 0)), (5.2, -40, (-1.6, 0)), (5.2, -16.5, (-1.6, 0)),
]  # fmt: skip
HEDGES = [
    ((0, 21.5), (112, 1.6), 3.2), ((0, -58.5), (112, 1.6), 3.4),
    ((55.5, -34), (1.6, 48), 3.2), ((-55.5, -34), (1.6, 48), 3.2),
    ((55.5, 15), (1.6, 14), 3.0), ((-55.5, 15), (1.6, 14), 3.0),
    ((-36, -24.5), (18, 1.2), 1.6), ((35, -23.5), (16, 1.2), 1.6),
    ((-31.5, -50), (43, 1.4), 2.6), ((31.5, -50), (43, 1.4), 2.6),
]  # fmt: skip


def _lamp(city: Scenery, x: float, y: float, arm: tuple[float, float]) -> None:
    """Append a lamp pole with an arm of the given extent over the road, metres."""
    city.solid((x, y, 0), [0.14, 0.10, 0.08], [0.0, 0.9, 5.6], "pole", 8)
    length = float(np.hypot(*arm))
    angle = float(np.arctan2(arm[1], arm[0]))
    middle = np.array([x + arm[0] / 2, y + arm[1] / 2, 5.5])
    city.box(middle, (length, 0.12, 0.12), "pole", angle)
    head = np.array([x + arm[0], y + arm[1], 5.42])
    city.box(head, (0.75, 0.32, 0.2), "lamp", angle)


def _sign(
    city: Scenery, x: float, y: float, face: float, colour: str, kind: str
) -> None:
    """Append a sign whose front looks along the angle face, radians."""
    city.solid((x, y, 0), [0.06, 0.06], [0.0, 2.0], "pole", 6)
    place = np.array([x, y, 0.0]) + 0.09 * np.array([np.cos(face), np.sin(face), 0])
    if kind == "square":
        city.box(place + [0, 0, 1.9], (0.1, 0.8, 0.8), colour, face)
    elif kind == "wide":
        city.box(place + [0, 0, 1.8], (0.1, 1.8, 0.9), colour, face)
        city.box(
            place + [0.04 * np.cos(face), 0.04 * np.sin(face), 2.15],
            (0.1, 1.5, 0.2), "white", face,
        )  # fmt: skip
    else:
        city.disc(place + [0, 0, 2.3], 0.48, 0.1, face, colour)


def _car(city: Scenery, x: float, y: float, angle: float, colour: str) -> None:
    """Append a parked car of two boxes on four dark wheels."""
    place = np.array([x, y, 0.12])
    city.box(place + [0, 0, 0.3], (4.2, 1.75, 0.62), colour, angle)
    city.box(place + [0, 0, 0.92], (2.3, 1.6, 0.55), "glass", angle)
    city.box(place + [0, 0, 1.47], (2.1, 1.5, 0.08), colour, angle)
    city.box(place, (3.3, 1.6, 0.3), "dark", angle)


def _bus_stop(city: Scenery, x: float, y: float) -> None:
    """Append a shelter that opens to the south."""
    for dx in (-1.9, 1.9):
        for dy in (-0.6, 0.6):
            city.box((x + dx, y + dy, 0.12), (0.12, 0.12, 2.4), "blue")
    city.box((x, y + 0.62, 0.5), (3.8, 0.08, 1.7), "cyan")
    city.box((x, y, 2.5), (4.4, 1.7, 0.16), "blue")
    city.box((x, y + 0.3, 0.12), (2.6, 0.4, 0.45), "wood")
    city.box((x - 2.6, y - 0.3, 0.12), (0.5, 0.16, 1.9), "yellow")


def _fence(city: Scenery, start, end, colours: tuple[str, ...]) -> None:
    """Append a fence of panels 2 m long in turning colours."""
    start, end = np.array(start, dtype=float), np.array(end, dtype=float)
    length = float(np.linalg.norm(end - start))
    angle = float(np.arctan2(*(end - start)[::-1]))
    count = max(1, round(length / 2.0))
    for k in range(count):
        x, y = start + (end - start) * (k + 0.5) / count
        size = (length / count - 0.1, 0.1, 1.0)
        city.box((x, y, 0.12), size, colours[k % len(colours)], angle)


def furnish(city: Scenery) -> None:
    """Append everything that is not a building."""
    rng = np.random.default_rng(7)
    for k, (x, y) in enumerate(TREES):
        city.tree(x, y, rng.uniform(0.85, 1.25), _CROWNS[k % 3])
    for x, y, arm in LAMPS:
        _lamp(city, x, y, arm)
    for (x, y), (width, depth), height in HEDGES:
        city.box((x, y, 0.0), (width, depth, height), "hedge")
    _bus_stop(city, -13.5, 6.9)
    _sign(city, 4.5, -14.1, -np.pi / 2, "red", "octagon")
    _sign(city, 21.9, -4.4, np.pi, "blue", "square")
    _sign(city, 26.6, 4.4, 0.0, "blue", "square")
    _sign(city, -11.5, -4.5, np.pi, "yellow", "square")
    _sign(city, 6.0, 6.6, -np.pi / 2, "green", "wide")
    _sign(city, 33.0, -4.6, np.pi, "orange", "octagon")
    _sign(city, -27.0, 4.5, 0.0, "purple", "octagon")
    _car(city, 23.6, 13.0, np.pi / 2, "red")
    _car(city, -19.6, 13.5, np.pi / 2, "white")
    _car(city, 10.8, 13.5, np.pi / 2, "blue")
    _car(city, 26.2, -13.0, np.pi / 2, "yellow")
    _car(city, -29.5, -11.5, np.pi / 2, "cyan")
    _car(city, 13.0, -24.0, 0.0, "orange")
    _fence(city, (-45, -8), (-33, -8), ("white", "wood"))
    _fence(city, (28, -8), (41, -8), ("green", "white"))
    _fence(city, (-7.2, -29), (-7.2, -42), ("red", "white"))
    _fence(city, (7.4, -26.5), (7.4, -34), ("yellow", "dark"))
    _fence(city, (-46, -45.8), (-6.5, -45.8), ("wood",))
    _fence(city, (6.5, -45.8), (46, -45.8), ("wood",))
    _fence(city, (48, -5), (48, 5), ("red", "white"))
    _fence(city, (-48, -5), (-48, 5), ("orange", "white"))
    _fence(city, (-5, -47.7), (5, -47.7), ("red", "white"))
    for x, y, colour in ((7.2, 7.4, "orange"), (-31, 7.5, "red"), (15, -7.6, "pink")):
        city.box((x, y, 0.12), (1.1, 0.9, 1.2), colour)
    for x, y, colour in ((-7.4, -14.5, "purple"), (7.2, -13, "blue"), (35, 7.4, "red")):
        city.box((x, y, 0.12), (0.8, 0.8, 1.0), colour)
    city.box((-17, -8.6, 0.12), (3.0, 1.0, 1.1), "green")
    city.box((43, 7.5, 0.12), (3.2, 1.2, 1.5), "yellow")
    city.box((-7.6, -24.5, 0.12), (1.0, 2.6, 1.4), "cyan")
