"""A ZED's calibration file and frames, as the device would give them."""

from __future__ import annotations

import numpy as np

PINHOLE = (351.2, 349.6, 330.4, 185.3)  # fx, fy, cx, cy of VGA, as OpenCV counts
DISTORTION = (-0.1712, 0.0261, 0.0008, -0.0005, 0.0)  # k1, k2, p1, p2, k3
WIDTH, HEIGHT = 672, 376


def calibration_text(distortion: tuple[float, ...] = DISTORTION) -> str:
    """Write a file of VGA and HD720, both eyes."""
    sections = ""
    for end, scale in (("VGA", 1.0), ("HD", 1280 / 672)):
        for eye in ("LEFT", "RIGHT"):
            sections += f"[{eye}_CAM_{end}]\n"
            values = [scale * value for value in PINHOLE]
            names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
            for name, value in zip(names, (*values, *distortion), strict=True):
                sections += f"{name} = {value}\n"
            sections += "\n"
    return sections + "[STEREO]\nBaseline = 119.9\nTY = 0.1\nCV_VGA = 0.002\n"


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the colours, 0 to 255, of what lies in the direction (x, y, 1)."""
    red, green = 128 + 100 * np.sin(25 * x), 128 + 100 * np.cos(25 * y)
    return np.stack([red, green, 128 + 40 * (x + y)], axis=-1)


def both_eyes(distortion: tuple[float, ...] = DISTORTION) -> np.ndarray:
    """Return a frame (376, 1344, 3): the pattern by distorted lenses left, white right.

    The directions are found by fixed-point iteration, in double precision.
    """
    k1, k2, p1, p2, k3 = distortion
    fx, fy, cx, cy = PINHOLE
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    u, v = (columns - cx) / fx, (rows - cy) / fy
    x, y = u, v
    for _ in range(200):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (u - dx) / radial, (v - dy) / radial
    left = np.rint(pattern(x, y)).astype(np.uint8)
    return np.concatenate([left, np.full_like(left, 255)], axis=1)
