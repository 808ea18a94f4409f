"""The sRGB curve (IEC 61966-2-1) for NumPy arrays, and images in eight bits.

Everything rendered is linear Rec.709 RGB; files and policies see sRGB. Dr.Jit's arrays
have `drjit.linear_to_srgb` and `drjit.srgb_to_linear`. Both libraries map values below
0 to 0 and values above 1 to 1; a NaN stays a NaN.
"""

from __future__ import annotations

import numpy as np

_LINEAR_KNEE = 0.0031308
_SRGB_KNEE = 0.04045


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
