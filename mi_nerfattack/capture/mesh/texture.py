"""Textures of meshes: decoding them, and how they go on beyond their edges."""

from __future__ import annotations

from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.files import MAX_IMAGE_PIXELS

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", None)  # None: made by trimesh
_BEYOND = 1e-4  # of the texture's edge


def flat_texture(image: Any, mode: str) -> np.ndarray:
    """Decode a PIL image of limited size and known format.

    Args:
        image: as opened, not yet decoded.
        mode: "RGB" or "RGBA".

    Returns:
        (height, width, 3 or 4), uint8 sRGB.
    """
    if image.format not in _FORMATS:
        raise InputError(f"texture: is a {image.format} image; use PNG or JPEG")
    if image.width * image.height > MAX_IMAGE_PIXELS:
        raise InputError(
            f"texture: {image.width} x {image.height} pixels; at most "
            f"{MAX_IMAGE_PIXELS} are read"
        )
    if image.mode not in ("1", "L", "P", "RGB", "LA", "PA", "RGBA"):
        raise InputError(
            f"texture: pixel type {image.mode}; use 8 bits a channel, grey or RGB"
        )
    return np.array(image.convert(mode), dtype=np.uint8)


def laid_out(
    texture: np.ndarray, uv: np.ndarray, wrap: tuple[str, str]
) -> tuple[np.ndarray, np.ndarray, str]:
    """Express two ways of going on beyond the edges by one for both axes.

    Args:
        texture: (h, w, channels).
        uv: (n, 2), origin at the bottom left.
        wrap: "repeat", "mirror" or "clamp" along u and v.

    Returns:
        texture and uv, either of them possibly changed, and the common way.

    Raises:
        InputError: one axis clamps and the other does not, and both matter.
    """
    if not np.all(np.isfinite(uv)):
        raise InputError("a texture coordinate is NaN or infinite")
    if wrap[0] == wrap[1]:
        return texture, uv, wrap[0]
    beyond = np.any((uv < -_BEYOND) | (uv > 1 + _BEYOND), axis=0)
    for axis in (0, 1):
        if not beyond[axis]:
            return texture, uv, wrap[1 - axis]
    if "clamp" in wrap:
        raise InputError(
            f"a texture goes on as {wrap[0]} along u and {wrap[1]} along v, with "
            "coordinates beyond [0, 1] along both; use one way for both"
        )
    axis = wrap.index("mirror")
    both = np.concatenate([texture, np.flip(texture, 1 - axis)], axis=1 - axis)
    if axis == 1:
        # v = 0 is the bottom row, and the mirror image lies above the first one
        both = np.concatenate([np.flip(texture, 0), texture])
    scale = np.array([0.5, 1.0] if axis == 0 else [1.0, 0.5])
    return both, uv * scale, "repeat"
