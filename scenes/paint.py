"""Images painted with NumPy: smooth noise, grids of pixels, PNG files.

Colours are sRGB in [0, 1] until they are written as 8-bit PNG files.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an sRGB image (h, w, 3) in [0, 1] as an 8-bit PNG."""
    buffer = io.BytesIO()
    data = np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)
    Image.fromarray(data).save(buffer, format="png", optimize=True)
    path.write_bytes(buffer.getvalue())


def value_noise(x: np.ndarray, y: np.ndarray, cell: float, seed: int) -> np.ndarray:
    """Return smooth noise in [-1, 1] at x, y, metres, with features of size cell."""
    lattice = np.random.default_rng(seed).uniform(-1, 1, (64, 64))
    i, j = np.floor(x / cell).astype(int), np.floor(y / cell).astype(int)
    u, v = x / cell - i, y / cell - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low = lattice[i % 64, j % 64] * (1 - u) + lattice[(i + 1) % 64, j % 64] * u
    high = lattice[i % 64, (j + 1) % 64] * (1 - u)
    high = high + lattice[(i + 1) % 64, (j + 1) % 64] * u
    return low * (1 - v) + high * v


def pixel_grid(
    x0: float, x1: float, y0: float, y1: float, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (h, w) of the pixel centres; row 0 lies at y1."""
    width, height = round((x1 - x0) * scale), round((y1 - y0) * scale)
    x = x0 + (np.arange(width) + 0.5) / scale
    y = y1 - (np.arange(height) + 0.5) / scale
    across, up = np.meshgrid(x, y)
    return across, up


def coverage(distance: np.ndarray, scale: float) -> np.ndarray:
    """Return the antialiased coverage in [0, 1] of a region.

    Args:
        distance: to the region's border, positive inside, metres.
        scale: pixels per metre.
    """
    return np.clip(0.5 + distance * scale, 0.0, 1.0)
