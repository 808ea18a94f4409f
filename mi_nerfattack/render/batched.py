"""Gradients of a field's parameters through a march, in whichever way is faster."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.base import AbstractPoints
from mi_nerfattack.render.march import march_derivative, private_gradients
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays, pick_rays
from mi_nerfattack.render.sums import Rest
from mi_nerfattack.render.walk import Walk

CAPACITY = 1 << 17  # points collected at a time, whatever the number of samples
FIRST_RAYS = 1 << 13  # in the first batch; then as many as fill the capacity


def march_gradient(
    posed: PosedField, rays: Rays, primal: March, cotangent: March, stop: float
) -> None:
    """Accumulate gradients of the parameters of a field that ask for them.

    Gives what :func:`march_derivative` gives in backward mode, without derivatives by
    the rays. Where the field can differentiate at many points faster than one by one,
    the march only collects the points, in batches of a fixed size, so that memory is
    independent of the number of samples.

    Args:
        posed: the field at its pose.
        rays: n rays.
        primal: what :func:`march` returned for them.
        cotangent: derivative of the objective by `primal`.
        stop: as given to :func:`march`.
    """
    if posed.has_gain or not posed.field.collects_points:
        mode = dr.ADMode.Backward
        march_derivative(mode, posed, rays, primal, cotangent, stop)
        return
    start, width, total = 0, FIRST_RAYS, dr.width(rays.direction)
    capacity = CAPACITY
    while start < total:
        width = min(width, total - start)
        index = dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, width)
        part = [pick_rays(value, index) for value in (rays, primal, cotangent)]
        points = posed.field.points(capacity)
        with dr.suspend_grad():
            heading = _collect(points, posed, *part, stop)
        count = points.count()
        if count <= capacity:
            with dr.resume_grad(), private_gradients():
                points.accumulate(heading)
            start += width
        capacity = max(CAPACITY, count if width == 1 else 0)
        width = max(1, int(0.85 * width * CAPACITY / max(count, 1)))


@dr.syntax
def _collect(
    points: AbstractPoints,
    posed: PosedField,
    rays: Rays,
    primal: March,
    cotangent: March,
    stop: float,
) -> mi.Vector3f:
    """Replay a march, collect its points, and return the rays' local directions."""
    walk, active = Walk.start(posed, rays)
    heading = walk.paths[0].heading
    ray = dr.arange(mi.UInt32, dr.width(rays.direction))
    rest = Rest.of(primal)
    while active:
        walk, here = walk.next([posed], active)
        point = walk.paths[0].at(here.t)
        density, colour, place = points.eval(point, heading, here.active)
        (x,) = here.depths([posed.in_world(density)])
        rest, slope = rest.minus([x], [colour], here.t)
        by_light = slope.given * cotangent.radiance
        by_depth = cotangent.pair(slope.by_depth) + dr.dot(by_light, colour)
        by_density = posed.in_world(here.width * by_depth)
        points.append(place, by_density, x * by_light, ray, here.active)
        active = here.active & (dr.exp(-rest.tau) > stop)
    return heading
