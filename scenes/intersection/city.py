"""The buildings, and everything above ground as one mesh."""

from __future__ import annotations

from collections.abc import Callable

from ..atlas import Facade
from ..mesh import MeshBuilder
from ..scenery import Building, Scenery
from .layout import KERB_HEIGHT


def _look(wall, trim, floors, bays, shop="", tall=False) -> Facade:
    return Facade(wall, trim, floors, bays, shop, tall)


_PALE, _GREY, _DARK = (0.88, 0.86, 0.80), (0.60, 0.60, 0.60), (0.34, 0.33, 0.34)

BUILDINGS = [
    Building((-47, -35, 10, 19), 8.0, _look((0.70, 0.36, 0.30), _PALE, 3, 6), "gravel"),
    Building(
        (-32, -21, 9.5, 19),
        9.5,
        _look((0.90, 0.84, 0.66), _GREY, 3, 5, "green"),
        "tile",
    ),
    Building(
        (-18, -6, 11, 20), 6.2, _look((0.55, 0.69, 0.80), _PALE, 2, 5), "slate", True
    ),
    Building(
        (-3.5, 9, 9.5, 19),
        10.5,
        _look((0.80, 0.52, 0.36), _PALE, 4, 5, "red"),
        "gravel",
    ),
    Building(
        (12.5, 22, 11, 20), 6.5, _look((0.92, 0.77, 0.38), _PALE, 2, 4), "tile", True
    ),
    Building(
        (25, 36, 9.5, 19),
        9.0,
        _look((0.52, 0.66, 0.50), _DARK, 3, 7, "", True),
        "slate",
    ),
    Building(
        (38.5, 47, 10, 19),
        7.0,
        _look((0.66, 0.56, 0.70), _PALE, 2, 4, "blue"),
        "gravel",
    ),
    Building(
        (-45, -33, -21, -10.5),
        6.8,
        _look((0.86, 0.68, 0.64), _GREY, 2, 5),
        "tile",
        True,
    ),
    Building(
        (-26, -12, -22, -11.5),
        8.5,
        _look((0.86, 0.86, 0.84), _DARK, 3, 6, "orange"),
        "gravel",
    ),
    Building(
        (-21, -10.5, -42, -28), 7.5, _look((0.48, 0.56, 0.66), _PALE, 3, 5), "slate"
    ),
    Building(
        (11.5, 23, -21, -11),
        7.5,
        _look((0.62, 0.28, 0.26), _PALE, 2, 6, "yellow"),
        "gravel",
    ),
    Building(
        (28, 41, -20, -10.5), 6.0, _look((0.82, 0.80, 0.58), _DARK, 2, 6), "slate", True
    ),
    Building(
        (10.5, 20, -43, -27),
        9.0,
        _look((0.42, 0.60, 0.60), _PALE, 3, 5, "", True),
        "tile",
    ),
    Building(
        (50, 57, -11, 9), 8.5, _look((0.84, 0.60, 0.30), _DARK, 3, 8, "cyan"), "gravel"
    ),
    Building(
        (-58, -51, -10, 9),
        7.5,
        _look((0.68, 0.74, 0.80), _DARK, 3, 8, "", True),
        "slate",
    ),
    Building(
        (-10, 9.5, -57, -50.5),
        8.0,
        _look((0.78, 0.44, 0.46), _PALE, 3, 8, "purple"),
        "gravel",
    ),
]


def build_city(seed: int, furnish: Callable[[Scenery], None]) -> MeshBuilder:
    """Return everything above ground as one mesh.

    Args:
        seed: of the trees' shapes.
        furnish: appends what is not a building.
    """
    city = Scenery(seed, len(BUILDINGS))
    for index, item in enumerate(BUILDINGS):
        city.building(index, item, KERB_HEIGHT)
    furnish(city)
    return city.mesh
