"""Images of the road surface, the pavement and the grass, sRGB in [0, 1]."""

from __future__ import annotations

import numpy as np

from ..paint import coverage, pixel_grid, value_noise
from .layout import ROAD_END, road_depth

PIXELS_PER_METRE = 25
SIDE_ROAD_TOP = -9.5
WHITE = np.array([0.90, 0.90, 0.88])
_LINE = 0.15


def _inside(distance: np.ndarray) -> np.ndarray:
    """Return the coverage of a region of the road's images from its distance."""
    return coverage(distance, PIXELS_PER_METRE)


def _rectangle(x, y, x0, x1, y0, y1) -> np.ndarray:
    """Return the coverage of an axis-aligned rectangle."""
    return _inside(np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y)))


def road_markings(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the coverage in [0, 1] of white paint at x, y, metres."""
    paint = _inside(0.5 * _LINE - np.abs(road_depth(x, y) - 0.35))
    period, dash = 6.0, 3.0
    for along, across, clear in ((np.abs(x), y, 10.0), (-y, x, 15.5)):
        phase = np.mod(along - clear, period)
        on = np.minimum(np.minimum(phase, dash - phase), along - clear)
        paint = np.maximum(paint, _inside(np.minimum(on, 0.075 - np.abs(across))))
    paint = np.maximum(paint, _rectangle(x, y, 0.25, 3.05, -14.3, -13.9))
    for k in range(-3, 3):
        stripe = _rectangle(x, y, k + 0.25, k + 0.75, -12.8, -10.2)
        paint = np.maximum(paint, stripe)
        stripe = _rectangle(x, y, 23.0, 25.6, k + 0.25, k + 0.75)
        paint = np.maximum(paint, stripe)
    return paint


def road_colour(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Return the sRGB colour (h, w, 3) of the road at x, y (h, w), metres."""
    tone = 0.47 + 0.022 * value_noise(x, y, 7.0, seed)
    tone = tone + 0.018 * value_noise(x, y, 2.5, seed + 1)
    tone = tone + 0.012 * value_noise(x, y, 0.6, seed + 2)
    wheels = np.where(np.abs(x) < 3.5, np.where(y < -3.5, x, y), y)
    wheels = np.abs(np.abs(np.abs(wheels) - 1.75) - 0.75)
    tone = tone - 0.018 * np.exp(-((wheels / 0.25) ** 2))
    for x0, x1, y0, y1, change in (
        (-33, -26.5, -3.1, -0.4, -0.06),
        (-15, -12.2, 0.5, 2.9, 0.05),
        (9.5, 15.5, -2.9, -0.5, 0.045),
        (28.5, 36, 0.4, 3.0, -0.055),
        (-2.9, -0.4, -27, -21.5, -0.055),
        (0.5, 2.9, -38, -33, 0.05),
        (-3.5, 1.2, -2.2, 1.4, -0.035),
    ):
        tone = tone + change * _rectangle(x, y, x0, x1, y0, y1)
    for cx, cy in ((-19.5, -0.9), (4.8, -2.4), (17.5, 1.2), (1.1, -18.5), (-37, 1.6)):
        tone = tone - 0.13 * _inside(0.38 - np.hypot(x - cx, y - cy))
    colour = tone[..., None] * np.array([1.0, 0.995, 0.985])
    wear = 0.93 + 0.05 * value_noise(x, y, 1.1, seed + 3)
    paint = (road_markings(x, y) * wear)[..., None]
    return colour * (1 - paint) + WHITE * paint


def road_images(seed: int) -> dict[str, np.ndarray]:
    """Return the images of the main road with its corners and of the side road."""
    main = pixel_grid(-ROAD_END, ROAD_END, SIDE_ROAD_TOP, 3.5, PIXELS_PER_METRE)
    side = pixel_grid(-3.5, 3.5, -ROAD_END, SIDE_ROAD_TOP, PIXELS_PER_METRE)
    return {
        "road_main": road_colour(*main, seed),
        "road_side": road_colour(*side, seed),
    }


def pavement_image(seed: int, length: float = 16.0, width: float = 2.62) -> np.ndarray:
    """Return a strip of kerb stone and slabs that repeats along its length.

    Row 0 is the foot of the kerb; the strip is unrolled over the kerb's edge.
    """
    scale = 64.0
    s, across = np.meshgrid(
        (np.arange(int(length * scale)) + 0.5) / scale,
        (np.arange(int(width * scale)) + 0.5) / scale,
    )
    rng = np.random.default_rng(seed)
    stones = rng.uniform(-0.025, 0.025, int(length))
    tone = 0.72 + stones[s.astype(int)]
    joint = 0.09 * (np.mod(s, 1.0) < 0.05)
    slabs = rng.uniform(-0.035, 0.035, (int(length / 0.8), 4))
    row = np.clip(((across - 0.37) / 0.75).astype(int), 0, 3)
    slab = 0.62 + slabs[(s / 0.8).astype(int) % len(slabs), row]
    gap = (np.mod(s, 0.8) < 0.06) | (np.mod(across - 0.37, 0.75) < 0.06)
    tone = np.where(across < 0.37, tone - joint, slab - 0.08 * gap)
    return tone[..., None] * np.array([1.0, 0.985, 0.95])


def grass_image(seed: int, extent: float = 80.0) -> np.ndarray:
    """Return the lawn seen from above: extent either side of the origin, metres."""
    x, y = pixel_grid(-extent, extent, -extent, extent, 512 / (2 * extent))
    a = value_noise(x, y, 9.0, seed) + 0.6 * value_noise(x, y, 3.0, seed + 1)
    b = value_noise(x, y, 5.0, seed + 2)
    base = np.array([0.42, 0.55, 0.27])
    light, dry = np.array([0.035, 0.04, 0.02]), np.array([0.035, 0.01, 0.015])
    return base + a[..., None] * light + b[..., None] * dry
