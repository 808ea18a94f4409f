"""Things above ground whose colours come from one atlas: boxes, buildings, trees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .atlas import Facade, facade_uv, swatch_uv
from .mesh import MeshBuilder, box_faces, prism, rotate_z
from .solids import trimesh

#: A foot at most this high, metres, stands on the ground: its lower side is hidden.
_ON_GROUND = 0.12
_UNIT = np.array([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)])


@dataclass(frozen=True)
class Building:
    """A box with windows.

    Attributes:
        plan: x0, x1, y0, y1, metres.
        height: of the walls above the ground, metres.
        facade: that all four walls show.
        roof: name of the roof's colour.
        gable: whether the roof has a ridge along x; otherwise it is flat, with a shed.
    """

    plan: tuple[float, float, float, float]
    height: float
    facade: Facade
    roof: str
    gable: bool = False


class Scenery:
    """Builds the one mesh that shares the texture atlas.

    Args:
        seed: of the trees' shapes.
        n_facades: in the atlas, above its row of plain colours.
    """

    def __init__(self, seed: int, n_facades: int) -> None:
        self.mesh = MeshBuilder()
        self._rng = np.random.default_rng(seed)
        self._n = n_facades

    def box(self, centre, size, colour: str, angle: float = 0.0) -> None:
        """Append a plain box that stands at centre (3,) of its foot, metres."""
        half = np.array([size[0] / 2, size[1] / 2, 0.0])
        high = half + [0, 0, size[2]]
        uv = swatch_uv(colour, self._n, _UNIT)
        faces = box_faces(-half, high)
        if centre[2] > _ON_GROUND:
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

    def building(self, index: int, item: Building, ground: float) -> None:
        """Append a building with its roof.

        Args:
            index: of its facade in the atlas.
            item: the building; its walls begin at z = 0.
            ground: from which its height counts, metres.
        """
        x0, x1, y0, y1 = item.plan
        low = np.array([x0, y0, 0.0])
        high = np.array([x1, y1, ground + item.height])
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
        ball, unit = lumpy_ball(self._rng)
        size = np.array([1.45, 1.45, 1.6]) * scale
        vertices = ball.vertices * size + foot + [0, 0, stem + 1.35 * scale]
        self.mesh.add(vertices, swatch_uv(colour, self._n, unit), ball.faces)


def lumpy_ball(
    rng: np.random.Generator, subdivisions: int = 2
) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return a closed ball of radius 1 with lumps, and coordinates in the unit square.

    Args:
        rng: of the lumps, whose standard deviation is about 0.13.
        subdivisions: of an icosahedron.

    Returns:
        The ball, and for each of its n vertices a place (n, 2) in an image.
    """
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    lumps = 1 + 0.13 * rng.standard_normal((6,)) @ np.sin(
        2.3 * ball.vertices @ rng.normal(size=(3, 6)) + np.arange(6)
    ).T / np.sqrt(3)
    unit = 0.5 + 0.45 * ball.vertices[:, [0, 2]]
    ball.vertices = ball.vertices * lumps[:, None]
    return ball, unit
