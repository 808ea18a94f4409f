"""OpenCV's lens distortion and its inverse: radial-tangential, or of a fisheye.

A lens is given by k1, k2, p1, p2, or by k1, k2, k3, k4 and a true `is_fisheye`, as
`Camera.distortion` holds it. Coordinates are those of the image plane at unit distance,
without unit. All functions take NumPy and Dr.Jit arrays alike. Directions at right
angles to the axis or behind have no place on the plane: see `direction`.

Source of the fisheye: Kannala and Brandt 2006, as `cv2.fisheye` has it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_NEWTON_STEPS = 8
_TINY = 1e-20  # of squares: keeps the middle of a fisheye's image differentiable


def distort(
    x: Any, y: Any, k1: Any, k2: Any, p1: Any, p2: Any, is_fisheye: Any = False
) -> tuple[Any, Any]:
    """Return the distorted position of the undistorted (x, y)."""
    r2 = x * x + y * y
    if is_fisheye:
        # Kannala and Brandt: the radius is a polynomial of the angle to the axis
        r = _library(x).sqrt(r2 + _TINY)
        stretch = bend(_arctan(r), k1, k2, p1, p2)[0] / r
        return x * stretch, y * stretch
    radial = 1 + r2 * (k1 + r2 * k2)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def jacobian(
    x: Any, y: Any, k1: Any, k2: Any, p1: Any, p2: Any, is_fisheye: Any = False
) -> tuple[Any, Any, Any, Any]:
    """Return dx'/dx, dx'/dy = dy'/dx, dy'/dy and the determinant of `distort`."""
    r2 = x * x + y * y
    if is_fisheye:
        r2 = r2 + _TINY
        r = _library(x).sqrt(r2)
        bent, slope = bend(_arctan(r), k1, k2, p1, p2)
        # Across the radius the picture stretches by the bend, along it by its slope
        across = bent / r
        along = slope / (1 + r2) - across
        xx, yy = across + along * x * x / r2, across + along * y * y / r2
        xy = along * x * y / r2
        return xx, xy, yy, xx * yy - xy * xy
    radial = 1 + r2 * (k1 + r2 * k2)
    # dr2/dx = 2 x, so the slope is twice the derivative of `radial` by r2
    slope = 2 * (k1 + 2 * k2 * r2)
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return xx, xy, yy, xx * yy - xy * xy


def undistort(
    u: Any, v: Any, k1: Any, k2: Any, p1: Any, p2: Any, is_fisheye: Any = False
) -> tuple[Any, Any]:
    """Invert `distort` by a fixed number of Newton steps from (u, v)."""
    if is_fisheye:
        x, y, z = direction(u, v, k1, k2, p1, p2)
        return x / z, y / z
    x, y = u, v
    for _ in range(_NEWTON_STEPS):
        fx, fy = distort(x, y, k1, k2, p1, p2)
        xx, xy, yy, determinant = jacobian(x, y, k1, k2, p1, p2)
        # Newton: the error times the inverse of the symmetric Jacobian
        ex, ey = fx - u, fy - v
        x = x - (yy * ex - xy * ey) / determinant
        y = y - (xx * ey - xy * ex) / determinant
    return x, y


def direction(
    u: Any, v: Any, k1: Any, k2: Any, k3: Any, k4: Any
) -> tuple[Any, Any, Any]:
    """Return the unit direction (right, down, forward) that a fisheye shows at (u, v).

    The position is the distorted one.
    """
    library = _library(u)
    radius = library.sqrt(u * u + v * v + _TINY)
    angle = unbend(radius, k1, k2, k3, k4)
    sine = library.sin(angle) / radius
    return u * sine, v * sine, library.cos(angle)


def bend(angle: Any, k1: Any, k2: Any, k3: Any, k4: Any) -> tuple[Any, Any]:
    """Return where a fisheye shows an angle (radians) from its axis, and the slope."""
    a2 = angle * angle
    radius = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
    return radius, slope


def unbend(radius: Any, k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    """Invert `bend` by a fixed number of Newton steps from the radius."""
    angle = radius
    for _ in range(_NEWTON_STEPS):
        bent, slope = bend(angle, k1, k2, k3, k4)
        angle = angle - (bent - radius) / slope
    return angle


def is_invertible(
    u: np.ndarray, v: np.ndarray, lens: tuple[float, ...], tolerance: float
) -> bool:
    """Tell whether `undistort` finds distorted positions again, without a fold.

    Args:
        u: horizontal positions all over an image.
        v: vertical positions all over an image.
        lens: as `Camera.distortion`.
        tolerance: of the positions.
    """
    with np.errstate(all="ignore"):
        # There and back again; and no fold, where the map would turn around
        if len(lens) > 4:
            radius, fisheye = np.hypot(u, v), lens[:4]
            angle = unbend(radius, *fisheye)
            error = abs(bend(angle, *fisheye)[0] - radius)
            # The radius must rise with the angle; 180 degrees and more count as a fold
            inner = np.linspace(0, angle.max(), 500)
            rising = np.where(inner < np.pi, bend(inner, *fisheye)[1], -1.0)
        else:
            x, y = undistort(u, v, *lens)
            back_u, back_v = distort(x, y, *lens)
            rising = jacobian(x, y, *lens)[3]
            error = np.maximum(abs(back_u - u), abs(back_v - v))
        return bool(np.all(error < tolerance) and np.all(rising > 0))


def _library(x: Any) -> Any:
    if isinstance(x, np.ndarray | float):
        return np
    import drjit

    return drjit


def _arctan(x: Any) -> Any:
    library = _library(x)
    return np.arctan(x) if library is np else library.atan(x)
