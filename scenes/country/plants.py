"""Trees and hedges: leaves as closed meshes with one image, trunks as scenery."""

from __future__ import annotations

import numpy as np

from ..mesh import MeshBuilder
from ..scenery import Scenery, lumpy_ball
from .ground import EXTENT, YARD, YARD_RADIUS, height
from .layout import LENGTH, at, road_distance
from .paint import leaves_uv

_SPECIES = ("oak", "birch", "beech", "oak", "spruce")
#: Hedges: arc lengths from and to, offset from the centre line, height.
HEDGES = [
    (20.0, 54.0, -9.0, 1.5), (98.0, 146.0, -10.0, 1.7), (58.0, 77.0, 9.2, 1.6),
    (2.0, 16.0, 9.0, 1.9), (128.0, 148.0, 9.5, 1.6),
]  # fmt: skip
_HEDGE_HALF = 0.75
_GROVE = 5.5


class Plants:
    """Builds the mesh of the leaves.

    Args:
        seed: of shapes and places.
        scenery: that takes the trunks.
    """

    def __init__(self, seed: int, scenery: Scenery) -> None:
        self.mesh = MeshBuilder()
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._scenery = scenery

    def ball(self, centre, radii, species: str, subdivisions: int) -> None:
        """Append a closed lump of leaves around a centre (3,), metres."""
        ball, unit = lumpy_ball(self._rng, subdivisions)
        vertices = ball.vertices * np.asarray(radii) + np.asarray(centre)
        self.mesh.add(vertices, leaves_uv(species, unit), ball.faces)

    def tree(self, x: float, y: float, scale: float, species: str, lumps: int) -> None:
        """Append a tree with a round crown of some lumps, or a spruce."""
        ground = float(height(np.array([x, y]), self._seed))
        foot = np.array([x, y, ground - 0.15])
        if species == "spruce":
            self._scenery.solid(foot, [0.2, 0.14], [0.0, 1.6 * scale], "trunk", 6)
            self._cone(foot, scale)
            return
        stem = 2.1 * scale
        colour = "white" if species == "birch" else "trunk"
        radii = [0.26 * scale, 0.17 * scale, 0.14 * scale]
        self._scenery.solid(foot, radii, [0.0, 0.6, stem + 0.9], colour, 7)
        middle = foot + [0, 0, stem + 1.45 * scale]
        size = scale * np.array([1.45, 1.45, 1.6])
        self.ball(middle, size, species, 2 if lumps > 3 else 1)
        for k in range(lumps):
            angle = 2 * np.pi * (k + self._rng.uniform(-0.3, 0.3)) / lumps
            out = scale * self._rng.uniform(0.85, 1.25)
            rise = scale * self._rng.uniform(-0.55, 0.9)
            place = middle + [out * np.cos(angle), out * np.sin(angle), rise]
            self.ball(place, scale * self._rng.uniform(0.65, 1.0), species, 1)

    def _cone(self, foot: np.ndarray, scale: float) -> None:
        """Append the crown of a spruce: closed, of five tiers."""
        sides = 9
        angle = 2 * np.pi * np.arange(sides) / sides
        rings = [(0.02, 0.9)]
        for k in range(5):
            rings += [
                (1.55 - 0.27 * k, 0.8 + 0.95 * k),
                (1.05 - 0.2 * k, 1.6 + 0.95 * k),
            ]
        rings.append((0.02, 6.2))
        rows, units = [], []
        for radius, z in rings:
            ragged = radius * (1 + 0.12 * self._rng.uniform(-1, 1, sides))
            ring = [ragged * np.cos(angle), ragged * np.sin(angle)]
            rows.append(scale * np.stack([*ring, np.full(sides, z)], axis=1))
            unit = [0.5 + 0.45 * np.cos(angle), np.full(sides, 1 - z / 6.3)]
            units.append(np.stack(unit, axis=1))
        self._tube(np.stack(rows) + foot, np.stack(units), "spruce")

    def _tube(self, rings: np.ndarray, units: np.ndarray, species: str) -> None:
        """Append the closed surface through rings (m, k, 3), counter-clockwise."""
        m, k = rings.shape[:2]
        number = np.arange(m * k).reshape(m, k)
        after = np.roll(number, -1, axis=1)
        quads = np.stack([number[:-1], after[:-1], after[1:], number[1:]], axis=-1)
        sides = quads.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        fan = np.array([[0, i, i + 1] for i in range(1, k - 1)])
        faces = np.concatenate([sides, fan[:, ::-1], fan + number[-1, 0]])
        uv = leaves_uv(species, units.reshape(-1, 2))
        self.mesh.add(rings.reshape(-1, 3), uv, faces)

    def hedge(self, start: float, end: float, offset: float, top: float) -> None:
        """Append a hedge along the road.

        Args:
            start: where it begins, arc length, metres.
            end: where it ends, arc lengths, metres.
            offset: of its middle from the centre line, metres.
            top: its height, metres.
        """
        s = np.linspace(start, end, round((end - start) / 0.8) + 1)
        half = np.array([0.75, 0, -0.75, -1, -0.9, 0.9, 1])
        rise = np.array([0.9, 1, 0.9, 0.45, 0, 0, 0.45])
        jitter = 1 + self._rng.uniform(-0.14, 0.14, (2, len(s), len(half)))
        across = offset + _HEDGE_HALF * half * jitter[0]
        up = top * rise * jitter[1]
        foot = height(at(s, offset), self._seed) - 0.1
        plan = at(np.broadcast_to(s[:, None], up.shape), across)
        rings = np.concatenate([plan, (foot[:, None] + up)[..., None]], axis=-1)
        u = np.abs(np.mod(s / 3.0, 2.0) - 1.0)  # back and forth, without a seam
        v = 1 - up / (1.2 * top)
        units = np.stack([np.broadcast_to(u[:, None], v.shape), v], axis=-1)
        self._tube(rings, units, "hedge")


def plant(seed: int, scenery: Scenery) -> MeshBuilder:
    """Return all leaves as one mesh, and give the trunks to the scenery."""
    plants = Plants(seed, scenery)
    for start, end, offset, top in HEDGES:
        plants.hedge(start, end, offset, top)
    rng = np.random.default_rng(seed + 1)
    taken = np.zeros((0, 2))
    # single trees on the slopes, then a belt of them on the crest
    for count, low, high, gap, lumps in ((48, 11.5, 34, 6.5, 5), (95, 36, 47, 5.0, 3)):
        tries = rng.uniform(-EXTENT + 8, EXTENT - 8, (6000, 2))
        distance = road_distance(tries)
        clear = np.linalg.norm(tries - YARD, axis=1) > YARD_RADIUS + 2
        planted = 0
        for x, y in tries[(distance > low) & (distance < high) & clear]:
            if planted == count:
                break
            if np.hypot(taken[:, 0] - x, taken[:, 1] - y).min(initial=gap) < gap:
                continue
            taken, planted = np.vstack([taken, (x, y)]), planted + 1
            species = _SPECIES[int(rng.integers(len(_SPECIES)))]
            plants.tree(x, y, rng.uniform(0.9, 1.6), species, lumps)
    for end in (0.0, LENGTH):
        _close(plants, end)
    return plants.mesh


def _close(plants: Plants, end: float) -> None:
    """Plant a grove where the road ends."""
    place = at(np.array([end]))[0]
    step = at(np.array([abs(end - 1.0)]))[0]
    outward = (place - step) / np.linalg.norm(place - step)
    side = np.array([-outward[1], outward[0]])
    for k in range(-3, 4):
        for row in range(2):
            x, y = place + outward * (_GROVE + 4 * row) + side * (3.2 * k + 1.6 * row)
            if road_distance(np.array([x, y])) > 5:
                scale, species = 1.0 + 0.1 * ((k + row) % 3), _SPECIES[(k + row) % 5]
                plants.tree(x, y, scale, species, 3)
