"""Gradients of a field's parameters through a march, in whichever way is faster."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.base import AbstractPoints
from mi_nerfattack.render.march import (
    MAX_INTERVALS,
    March,
    Rays,
    absorption,
    march_derivative,
    pick_rays,
    private_gradients,
    seek,
)
from mi_nerfattack.render.posed import PosedField

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
        march_derivative(mode, posed, *rays, primal, cotangent, stop)
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
    o, d = posed.to_local(rays.origin, rays.direction)
    near, far = posed.interval(o, d, rays.t_max)
    heading = dr.normalize(d)
    jitter = rays.jitter
    active = mi.Bool(rays.active) & (near < far)
    ray = dr.arange(mi.UInt32, dr.width(rays.direction))

    index = dr.floor(posed.lattice_index(near))
    tau = mi.Float(0)
    rest = mi.Color3f(primal.radiance)
    rest_moment = mi.Float(primal.moment)
    while active:
        index, t, width, active = seek(posed, o, d, index, near, far, jitter, active)
        density, colour, place = points.eval(o + t * d, heading, active)
        x = dr.select(active, posed.in_world(density) * width, 0)
        weight = dr.exp(-tau) * x * absorption(x)[0]
        behind = dr.exp(-tau - x)
        rest -= weight * colour
        rest_moment -= weight * t
        by_density = width * (
            dr.dot(cotangent.radiance, behind * colour - rest)
            + cotangent.opacity * (1 - primal.opacity)
            + cotangent.moment * (behind * t - rest_moment)
        )
        by_radiance = weight * cotangent.radiance
        points.append(place, posed.in_world(by_density), by_radiance, ray, active)
        tau += x
        index += 1
        active &= (behind > stop) & (index < MAX_INTERVALS)
    return heading
