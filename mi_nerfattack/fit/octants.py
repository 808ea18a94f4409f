"""Octants of a fitted field that a march may skip, by their density."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.base import AbstractField

#: Of a step near the camera: what gives less is skipped.
MIN_OPACITY = 0.03
_SAMPLES = 3  # along each edge of an octant


def dense_octants(field: AbstractField, min_opacity: float = MIN_OPACITY) -> np.ndarray:
    """Find the octants of occupied cells whose density a march has to see.

    Much of what a fit leaves between surfaces is a haze. An octant counts if one of 27
    places in it has at least the density of a step of `min_opacity`.

    Args:
        field: the field.
        min_opacity: of a step near the camera, in (0, 1).

    Returns:
        (rx, ry, rz) bytes, as `fields.occupancy.Occupancy` takes them.
    """
    cells = np.argwhere(field.window.cells)
    result = np.zeros(field.window.cells.shape, np.uint8)
    if len(cells):
        limit = mi.Float(-np.log1p(-min_opacity) / field.step_m)
        lower, extent = mi.Point3f(field.lower), mi.Vector3f(field.upper - field.lower)
        corner = mi.Point3f(cells.T.astype(np.float32))
        dr.make_opaque(limit, corner)
        scale = extent / mi.Vector3f(*map(float, result.shape))
        bits = _bits(field, lower, corner, scale, limit)
        result[tuple(cells.T)] = bits.numpy()
    return result


@dr.syntax
def _bits(
    field: AbstractField,
    lower: mi.Point3f,
    corner: mi.Point3f,
    scale: mi.Vector3f,
    limit: mi.Float,
) -> mi.UInt32:
    """Return the bits (n,) of cells with lower corners (3, n) in cells."""
    count = 2 * _SAMPLES
    bits, sample = mi.UInt32(0), mi.UInt32(0)
    while sample < count**3:
        place = [sample // count**2, sample // count % count, sample % count]
        octant = mi.UInt32(0)
        for index in place:
            octant = 2 * octant + index // _SAMPLES
        offset = mi.Vector3f(*[(mi.Float(index) + 0.5) / count for index in place])
        density = field.density(lower + (corner + offset) * scale, mi.Bool(True))
        bits |= dr.select(density >= limit, mi.UInt32(1) << octant, 0)
        sample += 1
    return bits
