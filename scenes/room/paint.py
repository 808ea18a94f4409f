"""Images of the room: floor with tape, and the four walls above one another.

Colours are sRGB in [0, 1].
"""

from __future__ import annotations

import numpy as np

from ..atlas import COLOURS
from ..paint import coverage, pixel_grid, value_noise
from .layout import HEIGHT, LENGTH, TAPE_WIDTH, WIDTH, track_distance

FLOOR_SCALE = 110.0
WALL_SCALE = 70.0
WALLS = ("south", "east", "north", "west")
_TAPE = np.array([0.10, 0.66, 0.26])
_TILE, _JOINT = 0.5, 0.012
_WALL_COLOURS = {
    "south": (0.86, 0.83, 0.74),
    "east": (0.66, 0.76, 0.84),
    "north": (0.84, 0.80, 0.86),
    "west": (0.87, 0.74, 0.64),
}
# on each wall: left, bottom, width, height (metres), kind, two colours
_ON_WALLS = {
    "south": [
        (0.5, 0.0, 0.9, 2.05, "plain", "wood", "dark"),
        (2.0, 0.7, 1.1, 0.8, "stripes", "red", "white"),
        (3.8, 0.5, 0.7, 1.0, "chequers", "dark", "yellow"),
        (5.0, 0.9, 0.6, 0.6, "disc", "white", "blue"),
    ],
    "east": [
        (0.4, 0.4, 1.0, 0.7, "disc", "yellow", "purple"),
        (1.8, 0.8, 1.5, 1.1, "window", "white", "cyan"),
        (3.7, 0.3, 0.8, 1.2, "bars", "blue", "white"),
    ],
    "north": [
        (0.6, 0.6, 1.4, 0.9, "window", "white", "cyan"),
        (2.5, 0.6, 1.4, 0.9, "window", "white", "cyan"),
        (4.5, 0.4, 1.0, 0.9, "chequers", "orange", "white"),
    ],
    "west": [
        (0.5, 0.5, 0.7, 0.9, "bars", "green", "pink"),
        (1.6, 0.4, 1.6, 1.0, "stripes", "dark", "concrete"),
        (3.7, 0.6, 0.9, 0.9, "disc", "orange", "dark"),
    ],
}


def floor_image(seed: int) -> np.ndarray:
    """Return the floor seen from above: grey tiles with the green tape."""
    x, y = pixel_grid(-LENGTH / 2, LENGTH / 2, -WIDTH / 2, WIDTH / 2, FLOOR_SCALE)
    tiles = np.random.default_rng(seed).uniform(-0.02, 0.02, (20, 20))
    column = np.floor((x + LENGTH) / _TILE).astype(int) % 20
    row = np.floor((y + WIDTH) / _TILE).astype(int) % 20
    tone = 0.60 + tiles[row, column] + 0.02 * value_noise(x, y, 0.4, seed)
    gap = np.minimum(np.mod(x, _TILE), np.mod(y, _TILE)) < _JOINT
    tone = tone - 0.07 * gap
    colour = tone[..., None] * np.array([1.0, 0.97, 0.92])
    edge = 0.5 * TAPE_WIDTH - np.abs(track_distance(x, y))
    tape = coverage(edge, FLOOR_SCALE)[..., None]
    return colour * (1 - tape) + _TAPE * tape


def wall_length(name: str) -> float:
    """Return the length of a wall, metres."""
    return LENGTH if name in ("south", "north") else WIDTH


def wall_rows() -> int:
    """Return the height in pixels of one wall's strip in the image of the walls."""
    return round(HEIGHT * WALL_SCALE)


def walls_image(seed: int) -> np.ndarray:
    """Return the walls in the order of `WALLS`, each as seen from inside."""
    image = np.full((len(WALLS) * wall_rows(), round(LENGTH * WALL_SCALE), 3), 0.6)
    for k, name in enumerate(WALLS):
        tile = _wall(name, seed + k)
        image[k * wall_rows() : (k + 1) * wall_rows(), : tile.shape[1]] = tile
    return image


def _wall(name: str, seed: int) -> np.ndarray:
    x, z = pixel_grid(0, wall_length(name), 0, HEIGHT, WALL_SCALE)
    noise = 1 + 0.015 * value_noise(x, z, 0.5, seed)
    image = noise[..., None] * np.array(_WALL_COLOURS[name])
    image[z < 0.1] = COLOURS["white"]
    for left, bottom, width, height, kind, first, second in _ON_WALLS[name]:
        u, v = (x - left) / width, (z - bottom) / height
        inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        frame = np.minimum(width * np.minimum(u, 1 - u), height * np.minimum(v, 1 - v))
        second_here = _PATTERNS[kind](u, v, frame)
        image[inside] = COLOURS[first]
        image[inside & second_here] = COLOURS[second]
    return image


def _bars(u: np.ndarray, v: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Bars of a diagram that stand on the picture's foot."""
    heights = np.array([0.35, 0.8, 0.5, 0.92, 0.65])
    column = np.clip((5 * u).astype(int), 0, 4)
    return (v < heights[column]) & (np.mod(5 * u, 1) > 0.25) & (frame > 0.03)


_PATTERNS = {
    "plain": lambda u, v, frame: frame < 0.05,
    "stripes": lambda u, v, frame: np.mod(5 * (u + v), 2) < 1,
    "chequers": lambda u, v, frame: (
        (np.floor(4 * u) + np.floor(5 * v)).astype(int) % 2 == 0
    ),
    "disc": lambda u, v, frame: np.hypot(u - 0.5, v - 0.5) < 0.36,
    "window": lambda u, v, frame: (frame > 0.06) & (np.abs(u - 0.5) > 0.03),
    "bars": _bars,
}
