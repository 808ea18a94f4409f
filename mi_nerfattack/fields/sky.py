"""An image of what lies behind a field, in all directions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError


def check_sky(image: np.ndarray) -> None:
    """Raise InputError unless an image is (height, width, 3), and there is some."""
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"sky: shape {image.shape}; expected (height, width, 3)")


def activate(raw: list[mi.Float]) -> mi.Color3f:
    """Turn raw colours, 3 x (n,), into linear ones."""
    return dr.srgb_to_linear(mi.Color3f(*[1 / (1 + dr.exp(-x)) for x in raw]))


def sky_colour(
    image: mi.Float, shape: tuple[int, int], direction: mi.Vector3f
) -> mi.Color3f:
    """Look up a latitude-longitude image of raw colours bilinearly.

    Args:
        image: (height width 3,), row by row from the zenith (+z).
        shape: height and width.
        direction: (3, n), unit vectors.

    Returns:
        (3, n), linear.
    """
    height, width = shape
    u = dr.atan2(direction.y, direction.x) * (0.5 / dr.pi) * width
    v = dr.safe_acos(direction.z) / dr.pi * height - 0.5
    u0, v0 = dr.floor(u), dr.floor(v)
    colour = mi.Color3f(0)
    for du in (0, 1):
        for dv in (0, 1):
            weight = (u - u0 if du else 1 - u + u0) * (v - v0 if dv else 1 - v + v0)
            column = mi.Int32(u0) + du
            column = dr.select(column < 0, column + width, column)
            column = dr.select(column >= width, column - width, column)
            column = dr.clip(column, 0, width - 1)  # where it is NaN
            row = dr.clip(mi.Int32(v0) + dv, 0, height - 1)
            index = mi.UInt32(row * width + column)
            colour += weight * dr.gather(mi.Color3f, image, index)
    return activate([colour.x, colour.y, colour.z])
