"""The sRGB curve (IEC 61966-2-1), for Dr.Jit arrays and for NumPy arrays.

Everything rendered is linear Rec.709 RGB; files and policies see sRGB.

Clip policy, the same in both directions and both libraries: values below 0 map to
0 and values above 1 map to 1, with derivative zero outside [0, 1] and the one of
the curve at 0 and 1 themselves; a NaN stays a NaN. `drjit.linear_to_srgb` is not used
because its derivative is NaN at 0 and because it maps NaN to a colour.
"""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import numpy as np

ArrayT = TypeVar("ArrayT", bound=dr.ArrayBase)

_LINEAR_KNEE = 0.0031308
_SRGB_KNEE = 0.04045


def linear_to_srgb(value: ArrayT) -> ArrayT:
    """Encode linear values of any Dr.Jit array type; differentiable.

    Args:
        value: linear, any shape; clipped to [0, 1].

    Returns:
        sRGB in [0, 1], same shape. The derivative is finite everywhere, at most 12.92.
    """
    is_dark = value <= _LINEAR_KNEE
    # the unused branch must stay away from 0, where its derivative is infinite
    bright = dr.select(is_dark, _LINEAR_KNEE, value)
    curve = dr.select(is_dark, value * 12.92, 1.055 * dr.power(bright, 1 / 2.4) - 0.055)
    return dr.select(value < 0, 0, dr.select(value > 1, 1, curve))


def srgb_to_linear(value: ArrayT) -> ArrayT:
    """Decode sRGB values of any Dr.Jit array type; differentiable.

    Args:
        value: sRGB, any shape; clipped to [0, 1].

    Returns:
        Linear values in [0, 1], same shape. The derivative is at most 2.28.
    """
    is_dark = value <= _SRGB_KNEE
    bright = dr.select(is_dark, _SRGB_KNEE, value)
    curve = dr.select(is_dark, value / 12.92, dr.power((bright + 0.055) / 1.055, 2.4))
    return dr.select(value < 0, 0, dr.select(value > 1, 1, curve))


def linear_to_srgb_numpy(value: np.ndarray) -> np.ndarray:
    """Encode linear values, clipped to [0, 1]; floating point in, same shape out."""
    value = np.clip(value, 0, 1)
    bright = np.maximum(value, _LINEAR_KNEE)
    return np.where(
        value <= _LINEAR_KNEE, 12.92 * value, 1.055 * bright ** (1 / 2.4) - 0.055
    ).astype(value.dtype)


def srgb_to_linear_numpy(value: np.ndarray) -> np.ndarray:
    """Decode sRGB values, clipped to [0, 1]; floating point in, same shape out."""
    value = np.clip(value, 0, 1)
    return np.where(
        value <= _SRGB_KNEE, value / 12.92, ((value + 0.055) / 1.055) ** 2.4
    ).astype(value.dtype)


def straight_rgba(premultiplied: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Encode premultiplied linear colours with alpha as 8-bit sRGB, not premultiplied.

    Args:
        premultiplied: (height, width, 3), linear; black where alpha is 0.
        alpha: (height, width, 1), in [0, 1].

    Returns:
        (height, width, 4), uint8.
    """
    colour = np.zeros_like(premultiplied)
    np.divide(premultiplied, alpha, out=colour, where=alpha > 0)
    opacity = np.round(255 * alpha).astype(np.uint8)
    return np.concatenate([linear_to_uint8(colour), opacity], axis=2)


def linear_to_uint8(value: np.ndarray) -> np.ndarray:
    """Encode linear values as 8-bit sRGB, rounded to nearest.

    Args:
        value: linear, any shape, floating point; finite.

    Raises:
        ValueError: a value is NaN or infinite, which eight bits cannot say.
    """
    if not np.all(np.isfinite(value)):
        raise ValueError(
            "linear_to_uint8: value contains NaN or infinity; "
            "only finite radiance can be written as an 8-bit image"
        )
    return np.round(255 * linear_to_srgb_numpy(value)).astype(np.uint8)
