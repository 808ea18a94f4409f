"""OpenCV's radial-tangential lens distortion (k1, k2, p1, p2) and its inverse.

Coordinates are those of the image plane at unit distance, without unit. All functions
are plain arithmetic and take NumPy and Dr.Jit arrays alike.
"""

from __future__ import annotations

from typing import Any

_NEWTON_STEPS = 8


def distort(x: Any, y: Any, k1: Any, k2: Any, p1: Any, p2: Any) -> tuple[Any, Any]:
    """Return the distorted position of the undistorted (x, y)."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def jacobian(
    x: Any, y: Any, k1: Any, k2: Any, p1: Any, p2: Any
) -> tuple[Any, Any, Any, Any]:
    """Return dx'/dx, dx'/dy = dy'/dx, dy'/dy and the determinant of `distort`."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    slope = 2 * (k1 + 2 * k2 * r2)
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return xx, xy, yy, xx * yy - xy * xy


def undistort(u: Any, v: Any, k1: Any, k2: Any, p1: Any, p2: Any) -> tuple[Any, Any]:
    """Invert `distort` by a fixed number of Newton steps from (u, v)."""
    x, y = u, v
    for _ in range(_NEWTON_STEPS):
        fx, fy = distort(x, y, k1, k2, p1, p2)
        xx, xy, yy, determinant = jacobian(x, y, k1, k2, p1, p2)
        ex, ey = fx - u, fy - v
        x = x - (yy * ex - xy * ey) / determinant
        y = y - (xx * ey - xy * ex) / determinant
    return x, y
