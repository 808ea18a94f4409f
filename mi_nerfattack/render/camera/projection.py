"""Where points are in a camera's image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mi_nerfattack.render.camera.distortion import distort, undistort
from mi_nerfattack.render.camera.intrinsics import Camera


def project(
    camera: Camera, points: np.ndarray, nearest: float = 1e-9
) -> tuple[np.ndarray, np.ndarray]:
    """Return where points are in the image, and whether they are in it.

    Args:
        camera: intrinsics.
        points: (..., 3), in the camera's frame.
        nearest: depth of the nearest point in the image, in the points' unit.

    Returns:
        (..., 2), right and down, pixels, without meaning behind the camera; and (...,).
    """
    inside = points[..., 2] > nearest
    depth = np.where(inside, points[..., 2], 1.0)
    x, y = points[..., 0] / depth, points[..., 1] / depth
    if camera.is_distorted:  # beyond the image it may fold back into it
        if camera.is_fisheye:
            inside &= np.hypot(x, y) <= camera.largest_slope
        else:
            across, down = _border(camera)
            inside &= (np.abs(x) <= across) & (np.abs(y) <= down)
        x, y = distort(x, y, *camera.distortion)
    u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    inside &= (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return np.stack([u, v], -1), inside


@lru_cache(maxsize=64)
def _border(camera: Camera) -> tuple[float, float]:
    """Return the largest undistorted |x| and |y| of the image's border."""
    u, v = np.linspace(0, camera.width, 33), np.linspace(0, camera.height, 33)
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    x, y = undistort(x, y, *camera.distortion)
    return float(np.abs(x).max()), float(np.abs(y).max())
