"""What a line of COLMAP's `cameras.txt` and `images.txt` says."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraRecord:
    """A camera: model by name, size in pixels, parameters in COLMAP's order."""

    camera_id: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ImageRecord:
    """An image: world to camera as (w, x, y, z) and translation, and its camera."""

    name: str
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
