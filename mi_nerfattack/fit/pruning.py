"""What of a fitted field may be left out: thin octants, and cells that nobody sees."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.march import STOP
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.render.walk import Walk

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


def seen_matter(
    field: AbstractField,
    images: PosedImages,
    indices: Iterable[int],
    min_weight: float,
    seed: int = 0,
) -> np.ndarray:
    """Find the occupied cells that show in images.

    A fit fills cells on both sides of a surface. In those behind it the density has had
    little part in what was compared, and in those before it is haze.

    Args:
        field: the field.
        images: whose rays are marched, at one random place of each interval.
        indices: of the images that count.
        min_weight: a cell counts if a sample in it has this weight in its ray's colour.
        seed: of the samples' places.

    Returns:
        (rx, ry, rz) of bool.
    """
    cells, posed = field.window.cells, PosedField(field)
    places = dr.rng(seed=seed)
    largest = dr.zeros(mi.Float, cells.size)
    shape = mi.Vector3u(*cells.shape)
    dr.make_opaque(largest, shape)
    for index in map(int, indices):
        pose = pose_arrays(images.camera_to_world[index])
        origin, direction = generate_rays(images.camera_of(index), *pose, 1)
        jitter = mi.Float(places.random(mi.Float, dr.width(direction)))
        rays = Rays(origin, direction, jitter=jitter)
        dr.make_opaque(rays)
        walk, active = Walk.start(posed, rays)
        dr.eval(_note_weights(posed, walk, active, shape, largest), largest)
    return cells & (largest.numpy().reshape(cells.shape) >= min_weight)


@dr.syntax
def _note_weights(
    posed: PosedField,
    walk: Walk,
    active: mi.Bool,
    shape: mi.Vector3u,
    largest: mi.Float,
) -> mi.Float:
    """Raise the largest weights of cells (cells,) to those of rays' samples."""
    depth = mi.Float(0)
    while active:
        walk, segment = walk.next([posed], active)
        active = segment.active
        point = walk.paths[0].at(segment.t)
        density = posed.in_world(posed.field.density(point, active))
        (step,) = segment.depths([density])
        weight = dr.exp(-depth) * (1 - dr.exp(-step))
        unit = dr.clip(posed.field.unit(point), 0, 1)
        cell = dr.minimum(mi.Vector3u(unit * mi.Vector3f(shape)), shape - 1)
        place = (cell.x * shape.y + cell.y) * shape.z + cell.z
        dr.scatter_reduce(dr.ReduceOp.Max, largest, weight, place, active)
        depth += step
        active &= dr.exp(-depth) > STOP
    return depth
