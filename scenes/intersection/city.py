"""Everything above ground: buildings, hedges, trees, lamps and street furniture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from .facades import Facade, facade_uv, swatch_uv
from .layout import KERB_HEIGHT
from .mesh import MeshBuilder, box_faces, prism, rotate_z

_UNIT = np.array([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)])


@dataclass(frozen=True)
class Building:
    """A box with windows: plan (x0, x1, y0, y1) and height, metres, and its look."""

    plan: tuple[float, float, float, float]
    height: float
    facade: Facade
    roof: str
    gable: bool = False


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


class City:
    """Builds the one mesh that shares the texture atlas.

    Args:
        seed: of the trees' shapes.
        n_facades: in the atlas, above its row of plain colours.
    """

    def __init__(self, seed: int, n_facades: int = len(BUILDINGS)) -> None:
        self.mesh = MeshBuilder()
        self._rng = np.random.default_rng(seed)
        self._n = n_facades

    def box(self, centre, size, colour: str, angle: float = 0.0) -> None:
        """Append a plain box that stands at centre (3,) of its foot, metres."""
        half = np.array([size[0] / 2, size[1] / 2, 0.0])
        high = half + [0, 0, size[2]]
        uv = swatch_uv(colour, self._n, _UNIT)
        faces = box_faces(-half, high)
        if centre[2] > KERB_HEIGHT:
            faces["bottom"] = faces["top"][::-1] - [0, 0, size[2]]
        for corners in faces.values():
            self.mesh.quad(rotate_z(corners, angle) + np.asarray(centre), uv)

    def solid(self, centre, radii, heights, colour: str, sides: int = 8) -> None:
        """Append the side wall of a solid of revolution at centre (3,), metres."""
        vertices, faces = prism(radii, heights, sides)
        angle = np.arctan2(vertices[:, 1], vertices[:, 0])
        unit = np.stack([0.5 + 0.45 * np.sin(angle), vertices[:, 2] / heights[-1]], 1)
        uv = swatch_uv(colour, self._n, unit)
        self.mesh.add(vertices + np.asarray(centre), uv, faces)

    def disc(self, centre, radius: float, depth: float, face: float, colour) -> None:
        """Append an upright octagonal plate that looks along the angle face."""
        angle = 2 * np.pi * (np.arange(8) + 0.5) / 8
        y, z = radius * np.cos(angle), radius * np.sin(angle)
        front = np.stack([np.full(8, depth / 2), y, z], axis=1)
        back = front * [-1, 1, 1]
        uv = swatch_uv(colour, self._n, 0.5 + 0.4 * np.stack([y, z], 1) / radius)
        place = np.asarray(centre)
        self.mesh.polygon(rotate_z(front, face) + place, uv)
        self.mesh.polygon(rotate_z(back[::-1], face) + place, uv[::-1])
        for i in range(8):
            j = (i + 1) % 8
            rim = np.array([back[i], back[j], front[j], front[i]])
            self.mesh.quad(rotate_z(rim, face) + place, uv[[i, j, j, i]])

    def building(self, index: int) -> None:
        """Append a building of the list with its roof."""
        item = BUILDINGS[index]
        x0, x1, y0, y1 = item.plan
        low = np.array([x0, y0, 0.0])
        high = np.array([x1, y1, KERB_HEIGHT + item.height])
        faces = box_faces(low, high)
        top = faces.pop("top")
        widest = max(x1 - x0, y1 - y0)
        bays = item.facade.bays
        for name, corners in faces.items():
            width = x1 - x0 if name in ("south", "north") else y1 - y0
            share = max(1, round(bays * width / widest)) / bays
            self.mesh.quad(corners, facade_uv(index, self._n, share))
        uv = swatch_uv(item.roof, self._n, _UNIT)
        if item.gable:
            self._gable(top, uv)
        else:
            self.mesh.quad(top, uv)
            rise = np.array([0.0, 0.0, 1.6])
            inner = np.array([x0 + 2.5, y0 + 3.0, high[2]])
            shed = box_faces(
                inner, np.array([inner[0] + 3, inner[1] + 3, inner[2]]) + rise
            )
            for corners in shed.values():
                self.mesh.quad(corners, swatch_uv("concrete", self._n, _UNIT))

    def _gable(self, top: np.ndarray, uv: np.ndarray) -> None:
        """Append a gable roof with the ridge along x that overhangs by 0.4 m."""
        (x0, y0, z), (x1, y1, _) = top[0], top[2]
        y, ridge = 0.5 * (y0 + y1), z + 0.32 * (y1 - y0)
        a, b = (x0 - 0.4, y, ridge), (x1 + 0.4, y, ridge)
        s0, s1 = (x0 - 0.4, y0 - 0.4, z - 0.1), (x1 + 0.4, y0 - 0.4, z - 0.1)
        n0, n1 = (x0 - 0.4, y1 + 0.4, z - 0.1), (x1 + 0.4, y1 + 0.4, z - 0.1)
        self.mesh.quad(np.array([s0, s1, b, a]), uv)
        self.mesh.quad(np.array([n1, n0, a, b]), uv)
        wall = swatch_uv("concrete", self._n, _UNIT[:3])
        self.mesh.polygon(np.array([(x1, y0, z), (x1, y1, z), (x1, y, ridge)]), wall)
        self.mesh.polygon(np.array([(x0, y1, z), (x0, y0, z), (x0, y, ridge)]), wall)

    def tree(self, x: float, y: float, scale: float, colour: str) -> None:
        """Append a tree: trunk and a lumpy crown with smooth shading."""
        foot = np.array([x, y, 0.0])
        stem = 1.9 * scale
        self.solid(foot, [0.2 * scale, 0.15 * scale], [0.0, stem + 0.5], "trunk", 7)
        ball = trimesh.creation.icosphere(subdivisions=2)
        lumps = 1 + 0.13 * self._rng.standard_normal((6,)) @ np.sin(
            2.3 * ball.vertices @ self._rng.normal(size=(3, 6)) + np.arange(6)
        ).T / np.sqrt(3)
        size = np.array([1.45, 1.45, 1.6]) * scale
        vertices = ball.vertices * lumps[:, None] * size
        vertices = vertices + foot + [0, 0, stem + 1.35 * scale]
        unit = 0.5 + 0.45 * ball.vertices[:, [0, 2]]
        self.mesh.add(vertices, swatch_uv(colour, self._n, unit), ball.faces)

    def lamp(self, x: float, y: float, arm: tuple[float, float]) -> None:
        """Append a lamp pole with an arm of the given extent over the road, metres."""
        self.solid((x, y, 0), [0.14, 0.10, 0.08], [0.0, 0.9, 5.6], "pole", 8)
        length = float(np.hypot(*arm))
        angle = float(np.arctan2(arm[1], arm[0]))
        middle = np.array([x + arm[0] / 2, y + arm[1] / 2, 5.5])
        self.box(middle, (length, 0.12, 0.12), "pole", angle)
        head = np.array([x + arm[0], y + arm[1], 5.42])
        self.box(head, (0.75, 0.32, 0.2), "lamp", angle)


def build_city(seed: int, furnish: Callable[[City], None]) -> MeshBuilder:
    """Return everything above ground as one mesh.

    Args:
        seed: of the trees' shapes.
        furnish: appends what is not a building.
    """
    city = City(seed)
    for index in range(len(BUILDINGS)):
        city.building(index)
    furnish(city)
    return city.mesh
