"""Images of the road, the ground and the leaves; colours are sRGB in [0, 1]."""

from __future__ import annotations

import numpy as np

from ..paint import coverage, pixel_grid, value_noise
from .ground import EXTENT, HALF_ROAD, YARD, YARD_RADIUS
from .layout import LANE_WIDTH, LENGTH, road_distance

ROAD_SCALE = 20.0
GROUND_PIXELS = 1024
LEAF_PIXELS = 128
#: Leaves by species: dark and bright colour.
LEAVES = {
    "oak": ((0.20, 0.31, 0.13), (0.46, 0.57, 0.25)),
    "birch": ((0.31, 0.42, 0.16), (0.61, 0.68, 0.31)),
    "beech": ((0.26, 0.25, 0.12), (0.55, 0.49, 0.23)),
    "spruce": ((0.12, 0.22, 0.15), (0.28, 0.41, 0.27)),
    "hedge": ((0.19, 0.29, 0.12), (0.42, 0.50, 0.24)),
}
_WHITE = np.array([0.86, 0.86, 0.83])
_GRASS = np.array([0.43, 0.53, 0.25])
# fields: middle, half sizes, angle, two colours of their stripes, width of a stripe
_FIELDS = [
    ((-34.0, -18.0), (24.0, 13.0), 0.5, (0.84, 0.76, 0.27), (0.79, 0.74, 0.30), 5.0),
    ((4.0, 38.0), (22.0, 10.0), -0.2, (0.50, 0.39, 0.28), (0.43, 0.33, 0.24), 1.6),
    ((64.0, -14.0), (14.0, 26.0), 0.3, (0.74, 0.68, 0.42), (0.69, 0.61, 0.37), 3.0),
    ((-60.0, 62.0), (16.0, 13.0), 0.9, (0.55, 0.62, 0.27), (0.49, 0.58, 0.26), 2.5),
]


def road_image(seed: int) -> np.ndarray:
    """Return the road unrolled, (h, w, 3): u along the road, row 0 at its left edge."""
    s, offset = pixel_grid(0, LENGTH, -HALF_ROAD, HALF_ROAD, ROAD_SCALE)
    tone = 0.45 + 0.03 * value_noise(s, offset, 9.0, seed)
    tone = tone + 0.02 * value_noise(s, offset, 2.0, seed + 1)
    tone = tone + 0.02 * value_noise(s, offset, 0.25, seed + 2)
    wheels = np.abs(np.abs(np.abs(offset) - LANE_WIDTH / 2) - 0.75)
    tone = tone - 0.025 * np.exp(-((wheels / 0.3) ** 2))
    for s0, s1, o0, o1, change in (
        (36, 41, -3.0, -0.3, -0.05), (57, 60, 0.2, 2.8, 0.04),
        (78, 84, 0.3, 3.0, -0.04), (96, 99, -2.9, -0.2, 0.045),
        (113, 117, -3.0, -0.5, -0.05),
    ):  # fmt: skip
        patch = np.minimum(
            np.minimum(s - s0, s1 - s), np.minimum(offset - o0, o1 - offset)
        )
        tone = tone + change * coverage(patch, ROAD_SCALE)
    colour = tone[..., None] * np.array([1.0, 0.985, 0.96])
    wear = 0.88 + 0.10 * value_noise(s, offset, 0.7, seed + 3)
    edge = 0.06 - np.abs(np.abs(offset) - LANE_WIDTH + 0.12)
    phase = np.mod(s, 7.5)
    dash = np.minimum(np.minimum(phase, 3.0 - phase), 0.06 - np.abs(offset))
    paint = coverage(np.maximum(edge, dash), ROAD_SCALE) * wear
    colour = colour * (1 - paint[..., None]) + _WHITE * paint[..., None]
    ragged = 0.13 * value_noise(s, offset, 0.8, seed + 4)
    ragged = ragged + 0.08 * value_noise(s, offset, 0.3, seed + 5)
    grass = coverage(np.abs(offset) - LANE_WIDTH - 0.24 + ragged, 0.4 * ROAD_SCALE)
    verge = _GRASS * (0.85 + 0.12 * value_noise(s, offset, 0.4, seed + 6)[..., None])
    return colour * (1 - grass[..., None]) + verge * grass[..., None]


def ground_image(seed: int) -> np.ndarray:
    """Return the ground from above: verges, meadow, fields, the yard and its drive."""
    scale = GROUND_PIXELS / (2 * EXTENT)
    x, y = pixel_grid(-EXTENT, EXTENT, -EXTENT, EXTENT, scale)
    distance = road_distance(np.stack([x, y], axis=-1))
    tone = 0.0
    for amplitude, cell in ((0.11, 11.0), (0.09, 4.0), (0.13, 1.1)):
        tone = tone + amplitude * value_noise(x, y, cell, seed + round(cell))
    dry = 0.5 + 0.5 * value_noise(x, y, 7.0, seed + 3)
    colour = _GRASS * (1 + tone[..., None])
    colour = colour + dry[..., None] * np.array([0.06, 0.02, 0.01])
    for (cx, cy), half, angle, one, two, stripe in _FIELDS:
        c, s = np.cos(angle), np.sin(angle)
        u, v = (x - cx) * c + (y - cy) * s, (y - cy) * c - (x - cx) * s
        edge = np.minimum(half[0] - np.abs(u), half[1] - np.abs(v))
        edge = np.minimum(edge, distance - 11.0) + value_noise(x, y, 2.0, seed + 4)
        share = (0.5 + 0.5 * np.sin(2 * np.pi * v / stripe))[..., None]
        crop = np.array(one) * share + np.array(two) * (1 - share)
        crop = crop * (1 + 0.7 * tone[..., None])
        mix = coverage(edge, 0.5 * scale)[..., None]
        colour = colour * (1 - mix) + crop * mix
    gravel = np.array([0.66, 0.61, 0.53]) * (1 + 0.7 * tone[..., None])
    yard = YARD_RADIUS - 3.0 - np.hypot(x - YARD[0], y - YARD[1] + 3.0)
    drive = np.minimum(1.7 - np.abs(x - YARD[0] + 4.0), YARD[1] - 4.0 - y)
    paths = np.maximum(yard, np.minimum(drive, y + 9.5))
    mix = coverage(paths + 0.5 * value_noise(x, y, 1.5, seed + 5), scale)[..., None]
    colour = colour * (1 - mix) + gravel * mix
    mown = coverage(5.2 - distance + 0.4 * value_noise(x, y, 2.5, seed + 6), scale)
    return colour * (1 + 0.10 * mown[..., None])


def leaves_image(seed: int) -> np.ndarray:
    """Return clumps of leaves, one cell for each species, side by side."""
    v, u = np.mgrid[0:LEAF_PIXELS, 0:LEAF_PIXELS] / 1.0
    cells = []
    for k, (dark, bright) in enumerate(LEAVES.values()):
        clumps = 0.6 * value_noise(u, v, 11.0, seed + 3 * k)
        clumps = clumps + 0.5 * value_noise(u, v, 4.5, seed + 3 * k + 1)
        clumps = clumps + 0.4 * value_noise(u, v, 2.0, seed + 3 * k + 2)
        share = np.clip(0.5 + 0.8 * clumps, 0, 1)[..., None]
        cells.append(np.array(dark) * (1 - share) + np.array(bright) * share)
    return np.concatenate(cells, axis=1)


def leaves_uv(species: str, unit: np.ndarray) -> np.ndarray:
    """Map coordinates in the unit square (n, 2) into the cell of a species."""
    margin = 2 / LEAF_PIXELS
    inside = margin + np.clip(unit, 0, 1) * (1 - 2 * margin)
    u = (list(LEAVES).index(species) + inside[:, 0]) / len(LEAVES)
    return np.stack([u, inside[:, 1]], axis=1)
