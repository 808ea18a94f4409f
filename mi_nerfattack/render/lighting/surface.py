"""Where rays meet the surface of a field, as far as it has one, and its normal there.

The point lies at the expected depth z (A.3). Moving a ray sideways changes z: on a
surface ``dz/do = -n / (n . d)``, so the derivative of the expected depth by the ray's
origin is a multiple of the normal. It is the replay of the march
(:func:`march_derivative`) plus the part that the march leaves out, the face of the
bounding box where the field begins at once: ``sigma (z - t_near) / a dt_near/do``.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.render.march import march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

FAINT = 1e-2  # opacity below which there is no surface to speak of


@dataclass
class Surface:
    """Points of surfaces, one a ray.

    Attributes:
        point: (3, n), metres in the world.
        normal: (3, n), unit vectors on the side that rays come from.
        active: (n,) mask; whether the ray meets anything.
    """

    point: mi.Point3f
    normal: mi.Vector3f
    active: mi.Bool


class Geometry(AbstractField):
    """The density of another field: black, and a constant of every derivative.

    Args:
        source: the field.
    """

    kind = "geometry"

    def __init__(self, source: AbstractField) -> None:
        self.source = source
        self.lower, self.upper = source.lower, source.upper
        self.step_m, self.cone = source.step_m, source.cone
        self.occupancy, self.window = source.occupancy, source.window

    def eval_everywhere(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """Evaluate the density alone; differentiable by `point`."""
        del direction
        with dr.suspend_grad(*self.source.arrays()):
            return self.source.density_everywhere(point, active), mi.Color3f(0)


def geometry(posed: PosedField) -> PosedField:
    """Return the density of a posed field; see :class:`Geometry`."""
    return PosedField(Geometry(posed.field), posed.placed)


def expected_surface(shape: PosedField, rays: Rays, stop: float) -> Surface:
    """Find points at the expected depth of a field alone, and normals.

    Where the opacity is below `FAINT`, or the field does not change along any
    direction, the normal faces the ray. Not differentiable.

    Args:
        shape: a :func:`geometry`.
        rays: n rays.
        stop: transmittance below which a ray ends.

    Source: appendix A.3 for the depth.
    """
    with dr.suspend_grad():
        # Depth z = moment / opacity (A.3, normalised), (n,)
        primal = march(shape, rays, stop)
        active = rays.active & (primal.opacity > 0)
        rate = dr.select(active, 1 / primal.opacity, 0)
        depth = dr.select(active, primal.moment * rate, 0)
        # dz/dmoment = 1 / a, dz/da = -z / a
        by_depth = March(mi.Color3f(0), -depth * rate, rate)
        _, by_rays = march_derivative(
            dr.ADMode.Backward,
            shape,
            rays,
            primal=primal,
            cotangent=by_depth,
            stop=stop,
            with_rays=True,
        )
        # dz/do, (3, n): through the march, and through the face of the box
        slope = by_rays.origin
        slope += rate * _entry_slope(shape, rays, depth, active=active)
        # The normal is parallel to dz/do, on the side that the ray comes from
        length = dr.norm(slope)
        clear = (length > 0) & (length < dr.inf) & (primal.opacity > FAINT)
        normal = dr.select(clear, slope / length, -rays.direction)
        away = dr.dot(normal, rays.direction) > 0
        normal = dr.select(away, -normal, normal)
        return Surface(rays.origin + depth * rays.direction, normal, active)


def _entry_slope(
    shape: PosedField, rays: Rays, depth: mi.Float, active: mi.Bool
) -> mi.Vector3f:
    """Differentiate by the origin what the depth owes to the face of the box."""
    o, d = shape.to_local(rays.origin, rays.direction)
    # Rays that enter the box from outside
    near, far = shape.interval(o, d, rays.t_max)
    entered = active & (near > 0) & (near < far)
    # Density just inside the face, 1/m; 0 in an empty cell
    inner = o + dr.fma(1e-3, far - near, near) * d
    distance, _ = shape.field.occupancy.query(shape.field.unit(inner), entered)
    density, _ = shape.eval(inner, d, entered & (distance == 0))
    # The face that is entered last: its plane fixes near by one coordinate alone.
    to_face = mi.Vector3f(o + near * d)
    lower = mi.Vector3f(*map(float, shape.field.lower))
    upper = mi.Vector3f(*map(float, shape.field.upper))
    gap = dr.abs(to_face - dr.select(d > 0, lower, upper)) / (upper - lower)
    is_face = gap == dr.min(gap)
    # dt_near/do = -1 / d along the normal of the face, else 0
    slope = dr.select(is_face, -1 / dr.select(is_face, d, 1), 0)
    in_world = shape.to_world_gradient(mi.Vector3f(slope), mi.Vector3f(0))[0]
    # The caller divides by the opacity
    return dr.select(entered, density * (depth - near), 0) * in_world
