"""Ground of the place: the road, a slab on flat verges, and hills around it."""

from __future__ import annotations

import numpy as np

from ..mesh import MeshBuilder
from ..paint import value_noise
from .layout import LANE_WIDTH, LENGTH, at, road_distance

#: Half of the slab's width: the lane, and a ragged edge that the image shows.
HALF_ROAD = LANE_WIDTH + 0.45
#: The verge lies lower than the road's surface, by less than what stands may rock.
VERGE_HEIGHT = -0.03
#: Within this distance of the centre line the ground is flat: things stand there.
FLAT = 9.0
#: The ground goes this far from the origin along x and y.
EXTENT = 120.0
#: Middle of the yard, its radius and its height.
YARD, YARD_RADIUS, YARD_HEIGHT = (31.0, 16.5), 11.0, 0.3
_CREST, _HILL = 44.0, 8.0
_SPACING = 2.5
_SKIRT = 0.25


def _ramp(t: np.ndarray) -> np.ndarray:
    """Return a smooth step from 0 at t = 0 to 1 at t = 1."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3 - 2 * t)


def height(places: np.ndarray, seed: int) -> np.ndarray:
    """Return the height of the ground (...), metres: hills that close the horizon.

    Args:
        places: (..., 2), world coordinates, metres.
        seed: of the hills.
    """
    x, y = places[..., 0], places[..., 1]
    distance = road_distance(places)
    hills = _HILL * (1 + 0.45 * value_noise(x, y, 38.0, seed))
    hills = hills * _ramp((distance - FLAT) / (_CREST - FLAT))
    bumps = 0.3 * value_noise(x, y, 9.0, seed + 1) * _ramp((distance - FLAT) / 10)
    # behind the crest the ground falls, so that nobody sees where it ends
    fall = 5.0 * _ramp((distance - _CREST - 6) / 30)
    ground = VERGE_HEIGHT + hills + bumps - fall
    yard = np.hypot(x - YARD[0], y - YARD[1]) - YARD_RADIUS
    level = np.where(distance < FLAT + 1, VERGE_HEIGHT, YARD_HEIGHT)
    return level + (ground - level) * _ramp(yard / 10)


def hills(seed: int) -> MeshBuilder:
    """Return the ground as a grid of heights that shows its image once."""
    mesh = MeshBuilder()
    n = round(2 * EXTENT / _SPACING) + 1
    line = np.linspace(-EXTENT, EXTENT, n)
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    corner = np.arange(n * (n - 1)).reshape(n - 1, n)[:, :-1].ravel()
    quads = np.stack([corner, corner + 1, corner + n + 1, corner + n], axis=1)
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    uv = 0.5 + places * [1, -1] / (2 * EXTENT)
    mesh.add(np.column_stack([places, height(places, seed)]), uv, faces)
    return mesh


def road(step: float = 0.5) -> MeshBuilder:
    """Return the road at z = 0 with its sides; u runs along it, v from left to right.

    Args:
        step: between two cross-sections, metres.
    """
    mesh = MeshBuilder()
    s = np.linspace(0, LENGTH, round(LENGTH / step) + 1)
    n = len(s)
    k = np.arange(n - 1)[:, None]
    section = (
        ((-HALF_ROAD, 0.0), (HALF_ROAD, 0.0)),
        ((HALF_ROAD, 0.0), (HALF_ROAD, -_SKIRT)),
        ((-HALF_ROAD, -_SKIRT), (-HALF_ROAD, 0.0)),
    )
    for ends in section:
        rows = []
        for offset, z in ends:
            rows.append(np.column_stack([at(s, offset), np.full(n, z)]))
        v = [0.5 - 0.499 * offset / HALF_ROAD for offset, _ in ends]
        uv = np.stack([np.tile(s / LENGTH, 2), np.repeat(v, n)], axis=1)
        quads = np.concatenate([k, k + 1, k + n + 1, k + n], axis=1)
        faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        mesh.add(np.concatenate(rows), uv, faces)
    return mesh
