"""Cells that a fit may fill, as far as depth maps tell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.base import AbstractField

_SMOOTH_RATIO = 1.5  # neighbours with depths closer than this lie on one surface


def grid_shape(
    lower: np.ndarray, upper: np.ndarray, resolution: int
) -> tuple[int, int, int]:
    """Return the cells along each axis, `resolution` along the longest.

    No axis has fewer than half of that: in the flat box of a street the surfaces lie
    flat too, and a ray above the ground should meet few occupied cells.
    """
    extent = np.asarray(upper, float) - lower
    counts = np.round(resolution * extent / extent.max())
    x, y, z = np.maximum((resolution + 1) // 2, counts).astype(int)
    return int(x), int(y), int(z)


@dataclass
class _Shell:
    """A grid of cells, and how thick a shell around surfaces is.

    Attributes:
        lower: (3,), corner of the grid, metres.
        scale: (3,), cells a metre.
        shape: (3,), cells along each axis.
        step_m: of the march, near the camera.
        cone: its growth with distance.
    """

    lower: mi.Point3f
    scale: mi.Vector3f
    shape: mi.Vector3f
    step_m: mi.Float
    cone: mi.Float

    def ends(self, eye: mi.Point3f, at: mi.Vector4f) -> list[mi.Vector3f]:
        """Return where rays enter and leave the shell, (3, n) each, in cells.

        Args:
            eye: their origin.
            at: (4, n), direction and inverse distance of the surface.
        """
        t = dr.rcp(at.w)
        heading = dr.normalize(mi.Vector3f(at.x, at.y, at.z))
        step = dr.maximum(self.step_m, self.cone * t)
        ends = t - self.step_m, t + step
        return [(eye + end * heading - self.lower) * self.scale for end in ends]


def cells_near_surfaces(
    views: Iterable[tuple[np.ndarray, np.ndarray]],
    field: AbstractField,
    shape: tuple[int, int, int],
) -> np.ndarray:
    """Mark the cells of a grid over a field's box in a shell around surfaces.

    Along each ray, the shell reaches from a near step before the surface to a step of
    the march behind it: wherever the ray's lattice lies, it has a sample in there.
    Between neighbouring pixels on one surface it is bilinear, since pixels at a grazing
    angle lie far apart.

    Args:
        views: from `depth_rays`.
        field: whose box and steps count.
        shape: of the grid.

    Returns:
        boolean `shape`.
    """
    lower = np.asarray(field.lower, float)
    scale = np.array(shape) / (np.asarray(field.upper) - lower)
    shell = _Shell(
        mi.Point3f(*lower.tolist()),
        mi.Vector3f(*scale.tolist()),
        mi.Vector3f(*map(float, shape)),
        step_m=mi.Float(field.step_m),
        cone=mi.Float(field.cone),
    )
    cells = dr.zeros(dr.uint8_array_t(mi.Float), int(np.prod(shape)))
    for eye, rays in views:
        origin = mi.Point3f(*eye.tolist())
        values, width = mi.Float(rays.ravel()), mi.UInt32(rays.shape[1])
        dr.make_opaque(shell, cells, origin, values, width)
        _mark(cells, shell, origin, _patches(values, width))
        dr.eval(cells)
    return cells.numpy().reshape(shape) > 0


def _patches(rays: mi.Float, width: mi.UInt32) -> list[mi.Vector4f]:
    """Return corners of patches: pixels, those on the right, below, and below right.

    Where a neighbour lies on another surface, the corner is that of the pixel.

    Args:
        rays: (4 n,), from `depth_rays`.
        width: of the image, pixels.
    """
    count = dr.width(rays) // 4
    pixel = dr.arange(mi.UInt32, count)
    right = dr.select((pixel + 1) % width == 0, 0, 1)
    below = dr.select(pixel + width < count, width, 0)
    moves = mi.UInt32(0), right, below, right + below
    at = [dr.gather(mi.Vector4f, rays, pixel + move) for move in moves]
    beside = _joined(at[0], at[1])
    under = _joined(at[0], at[2])
    return [at[0], beside, under, _joined(beside, _joined(under, at[3]))]


def _joined(pixel: mi.Vector4f, other: mi.Vector4f) -> mi.Vector4f:
    low, high = dr.minimum(pixel.w, other.w), dr.maximum(pixel.w, other.w)
    return dr.select(high < _SMOOTH_RATIO * low, other, pixel)


@dr.syntax
def _mark(cells: Any, shell: _Shell, eye: mi.Point3f, patch: list[mi.Vector4f]) -> None:
    """Mark the cells in the shell of patches.

    From one point to the next it is at most one cell along each axis.
    """
    points = [end for corner in patch for end in shell.ends(eye, corner)]
    nw, nu, nv = (_cells_along(points, bit) for bit in (1, 2, 4))
    low, high = reduce(dr.minimum, points), reduce(dr.maximum, points)
    active = (patch[0].w > 0) & dr.all((low < shell.shape) & (high > 0))
    i, j, k = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
    while active:
        u, v = mi.Float(i) / mi.Float(nu), mi.Float(j) / mi.Float(nv)
        above = dr.lerp(patch[0], patch[1], u)
        below = dr.lerp(patch[2], patch[3], u)
        first, last = shell.ends(eye, dr.lerp(above, below, v))
        cell = dr.floor(dr.lerp(first, last, mi.Float(k) / mi.Float(nw)))
        inside = dr.all((cell >= 0) & (cell < shell.shape))
        row = mi.UInt32(cell.x) * mi.UInt32(shell.shape.y) + mi.UInt32(cell.y)
        index = row * mi.UInt32(shell.shape.z) + mi.UInt32(cell.z)
        dr.scatter(cells, type(cells)(1), index, active & inside)
        k += 1
        i += dr.select(k > nw, 1, 0)
        k = dr.select(k > nw, 0, k)
        j += dr.select(i == nu, 1, 0)
        i = dr.select(i == nu, 0, i)
        active &= j < nv


def _cells_along(points: list[mi.Vector3f], bit: int) -> mi.UInt32:
    """Return the cells between points whose numbers differ in a bit, at least 1."""
    edges = [points[i + bit] - points[i] for i in range(8) if not i & bit]
    longest = reduce(dr.maximum, [dr.max(dr.abs(edge)) for edge in edges])
    return mi.UInt32(dr.ceil(dr.maximum(longest, 1)))
