"""Surfaces of a Mitsuba scene among fields."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError


def nearest_surface(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
    """Return the distance of the first surface that stops rays (n,), or infinity.

    What light passes straight, rays pass: `null`, what is not opaque of a `mask`, and
    `thindielectric`. They pass it whole: it does not dim the fields behind it, and what
    it reflects counts as behind all fields.

    Raises:
        InputError: a shape of the scene is `ellipsoids`.
    """
    shapes = scene.shapes()
    if not shapes:
        return mi.Float(dr.inf)
    for shape in shapes:
        if shape.is_ellipsoids():
            raise InputError(
                f"{shape.id()}: ellipsoids among the scene's shapes would hide the "
                "fields; nest a splat_background in field_integrator instead"
            )
    if any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null) for shape in shapes):
        return _walk_through(scene, ray, active)
    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    return dr.select(hit.is_valid(), hit.t, dr.inf)


@dr.syntax
def _walk_through(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
    """Do what :func:`nearest_surface` does where surfaces let light pass straight."""
    part = mi.Ray3f(ray)
    behind = mi.Float(0)
    nearest = mi.Float(dr.inf)
    searching = mi.Bool(active)
    while searching:
        si = scene.ray_intersect(part, mi.RayFlags.All, False, searching)
        met = searching & si.is_valid()
        passed = dr.max(si.bsdf().eval_null_transmission(si, met)) > 0
        nearest = dr.select(met & ~passed, behind + si.t, nearest)
        searching = met & passed
        behind += dr.select(searching, si.t, 0)
        part = si.spawn_ray(part.d)
        part.maxt = ray.maxt - behind
    return nearest
