"""Texture atlas of everything above ground: facades and a row of plain colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .paint import value_noise

TILE_WIDTH, TILE_HEIGHT = 512, 288
COLUMNS = 4
SWATCH_WIDTH, SWATCH_HEIGHT = 64, 64
WIDTH = TILE_WIDTH * COLUMNS

COLOURS = {
    "brick": (0.66, 0.33, 0.26),
    "slate": (0.36, 0.39, 0.44),
    "tile": (0.68, 0.36, 0.24),
    "gravel": (0.58, 0.56, 0.53),
    "crown_1": (0.38, 0.53, 0.25),
    "crown_2": (0.47, 0.57, 0.26),
    "crown_3": (0.31, 0.50, 0.33),
    "hedge": (0.36, 0.48, 0.28),
    "trunk": (0.43, 0.33, 0.25),
    "pole": (0.45, 0.47, 0.48),
    "lamp": (0.88, 0.87, 0.80),
    "red": (0.80, 0.15, 0.13),
    "blue": (0.13, 0.34, 0.72),
    "yellow": (0.92, 0.75, 0.14),
    "orange": (0.90, 0.48, 0.12),
    "green": (0.13, 0.52, 0.33),
    "white": (0.88, 0.88, 0.86),
    "cyan": (0.30, 0.68, 0.75),
    "purple": (0.50, 0.27, 0.58),
    "glass": (0.30, 0.38, 0.46),
    "wood": (0.62, 0.46, 0.30),
    "dark": (0.28, 0.28, 0.30),
    "pink": (0.86, 0.55, 0.58),
    "concrete": (0.66, 0.65, 0.62),
}


@dataclass(frozen=True)
class Facade:
    """What one facade shows: colours by sRGB triple, windows by count.

    Attributes:
        wall: colour of the wall.
        trim: colour of frames, plinth and bands.
        floors, bays: windows upwards and along.
        shop: name of the awning's colour, or an empty string for a dwelling.
        tall: whether windows take most of a floor's height.
    """

    wall: tuple[float, float, float]
    trim: tuple[float, float, float]
    floors: int
    bays: int
    shop: str = ""
    tall: bool = False


def _fill(image: np.ndarray, box: tuple, colour) -> None:
    """Paint the box (u0, u1, v0, v1), fractions of a tile with v up."""
    u0, u1, v0, v1 = box
    rows = slice(round((1 - v1) * TILE_HEIGHT), round((1 - v0) * TILE_HEIGHT))
    image[rows, round(u0 * TILE_WIDTH) : round(u1 * TILE_WIDTH)] = colour


def _shop_front(image: np.ndarray, facade: Facade, floor: float) -> None:
    """Paint shop windows, doors and a striped awning on the ground floor."""
    colour = np.array(COLOURS[facade.shop])
    for k in range(facade.bays):
        u0, u1 = (k + 0.08) / facade.bays, (k + 0.92) / facade.bays
        glass = (0.33, 0.42, 0.48) if k % 2 else (0.42, 0.47, 0.45)
        _fill(image, (u0, u1, 0.1 * floor, 0.62 * floor), glass)
    stripes = 4 * facade.bays
    for k in range(stripes):
        shade = colour if k % 2 else np.array(COLOURS["white"])
        box = (k / stripes, (k + 1) / stripes, 0.62 * floor, 0.78 * floor)
        _fill(image, box, shade)
    _fill(image, (0, 1, 0.80 * floor, 0.98 * floor), 0.75 * colour)


def paint_facade(facade: Facade, seed: int) -> np.ndarray:
    """Return the sRGB image (TILE_HEIGHT, TILE_WIDTH, 3) of a facade."""
    rng = np.random.default_rng(seed)
    image = np.empty((TILE_HEIGHT, TILE_WIDTH, 3))
    image[:] = facade.wall
    floor = 0.93 / facade.floors
    low, high = (0.14, 0.86) if facade.tall else (0.28, 0.80)
    for row in range(facade.floors):
        if row:
            _fill(image, (0, 1, row * floor, (row + 0.05) * floor), facade.trim)
        for k in range(facade.bays):
            u0, u1 = (k + 0.22) / facade.bays, (k + 0.78) / facade.bays
            v0, v1 = (row + low) * floor, (row + high) * floor
            frame = 0.012
            _fill(image, (u0 - frame, u1 + frame, v0 - 0.02, v1 + 0.02), facade.trim)
            glass = np.array([0.27, 0.35, 0.43]) * rng.uniform(0.85, 1.45)
            if rng.random() < 0.25:
                glass = np.array([0.78, 0.73, 0.62])
            _fill(image, (u0, u1, v0, v1), glass)
            middle = 0.5 * (u0 + u1)
            _fill(image, (middle - 0.005, middle + 0.005, v0, v1), facade.trim)
    if facade.shop:
        _fill(image, (0, 1, 0, floor), facade.trim)
        _shop_front(image, facade, floor)
    else:
        _fill(image, (0, 1, 0, 0.04), 0.7 * np.array(facade.trim))
        door = (facade.bays // 2 + 0.25) / facade.bays
        width = 0.5 / facade.bays
        _fill(image, (door, door + width, 0, 0.8 * floor), rng.uniform(0.2, 0.55, 3))
    _fill(image, (0, 1, 0.93, 1), facade.trim)
    v, u = np.mgrid[0:TILE_HEIGHT, 0:TILE_WIDTH] / 40.0
    return image * (1 + 0.05 * value_noise(u, v, 1.7, seed))[..., None]


def atlas_height(n_facades: int) -> int:
    """Return the height of the atlas in pixels."""
    rows = -(-n_facades // COLUMNS)
    return rows * TILE_HEIGHT + SWATCH_HEIGHT


def paint_atlas(facades: list[Facade], seed: int) -> np.ndarray:
    """Return the atlas (h, WIDTH, 3): facades in rows, plain colours at the foot."""
    height = atlas_height(len(facades))
    image = np.full((height, WIDTH, 3), 0.5)
    for k, facade in enumerate(facades):
        row, column = divmod(k, COLUMNS)
        top, left = row * TILE_HEIGHT, column * TILE_WIDTH
        tile = paint_facade(facade, seed + k)
        image[top : top + TILE_HEIGHT, left : left + TILE_WIDTH] = tile
    v, u = np.mgrid[0:SWATCH_HEIGHT, 0:SWATCH_WIDTH] / 1.0
    for k, (name, colour) in enumerate(COLOURS.items()):
        leaf = name.startswith(("crown", "hedge"))
        noise = value_noise(u, v, 12.0, seed + 100 + k) * (0.16 if leaf else 0.03)
        cell = np.array(colour) * (1 + noise[..., None])
        left = k * SWATCH_WIDTH
        image[-SWATCH_HEIGHT:, left : left + SWATCH_WIDTH] = cell
    return image


def facade_uv(index: int, n_facades: int, share: float) -> np.ndarray:
    """Return the uvs (4, 2) of a wall's corners, bottom left first.

    Args:
        index: of the facade in the atlas.
        n_facades: in the atlas.
        share: of the facade's width that the wall shows, at most 1.
    """
    row, column = divmod(index, COLUMNS)
    inset = 1.0
    u0 = (column * TILE_WIDTH + inset) / WIDTH
    u1 = (column * TILE_WIDTH + share * TILE_WIDTH - inset) / WIDTH
    height = atlas_height(n_facades)
    v0 = (row * TILE_HEIGHT + inset) / height
    v1 = ((row + 1) * TILE_HEIGHT - inset) / height
    return np.array([(u0, v1), (u1, v1), (u1, v0), (u0, v0)])


def swatch_uv(name: str, n_facades: int, unit: np.ndarray) -> np.ndarray:
    """Map unit-square coordinates (n, 2) into a plain colour's cell of the atlas."""
    k = list(COLOURS).index(name)
    height = atlas_height(n_facades)
    cell = 4 + np.clip(unit, 0, 1) * (SWATCH_WIDTH - 8)
    u = (k * SWATCH_WIDTH + cell[:, 0]) / WIDTH
    v = (height - SWATCH_HEIGHT + cell[:, 1]) / height
    return np.stack([u, v], axis=1)
