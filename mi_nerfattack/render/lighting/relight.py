"""Light inserted objects by a scene's emitters, and let them cast shadows.

A field holds the light that left its surfaces when it was captured. An inserted object
is lit otherwise in the scene: its radiance is read as a diffuse reflectance rho, so
that a ray shows ``rho E / pi`` with E the irradiance of the object's expected surface.
This holds for objects that ``capture.object_renders`` renders. The light there makes
the radiance of a surface that faces the key light equal to rho. Elsewhere it makes the
radiance at least 0.75 rho, except for occlusion. This shading stays in the object.

An object darkens its surroundings by a ratio: their irradiance with the object, divided
by their irradiance without it. Both irradiances come from the same light samples, so
the ratio is exactly 1 where no shadow ray meets an object. The ratio multiplies all
radiance, as if the object shadowed the light from other surfaces like the light from
the emitters.

Left out:

- Light from other surfaces, and shadows of fields that are not relit: an object in the
  shade of a captured house stands in the sun, and its shadow darkens a captured shadow
  once more. Shapes in the scene cast shadows.
- Self-shadows from less than `CLEARANCE` marching steps away, where a surface that is
  soft would shade itself.
- Colours of spectral emitters beyond RGB: irradiance is an RGB triple in all variants,
  in spectral ones from four wavelengths a light sample.

A point is the expected one of its ray: between two surfaces at silhouettes, and as
noisy as the field. Not differentiable: the light is a constant of all derivatives.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.lighting.surface import Surface, expected_surface, geometry
from mi_nerfattack.render.march import STOP, march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.render.scene_march import has_passages, nearest_surface

LIGHT_SAMPLES = 16
CLEARANCE = 2.0  # marching steps between a surface and where its shadow rays start
_GOLDEN, _SILVER = 0.618034, 0.414214  # steps of lattices


class Relighting:
    """Rule by which a scene's emitters light fields.

    One light sample is a direction of Mitsuba's emitter sampling with a shadow ray,
    which the scene's shapes and the relit fields block; other fields do not. There is
    no light from other surfaces.

    Args:
        relit: which of the fields are inserted objects, in their order.
        samples: light samples a ray and field.
        stop: transmittance below which a ray ends.
    """

    def __init__(
        self, relit: tuple[bool, ...], samples: int = LIGHT_SAMPLES, stop: float = STOP
    ) -> None:
        if samples < 1:
            raise InputError(f"relit_samples: {samples}; must be at least 1")
        self.relit, self.samples, self.stop = relit, samples, stop

    def gains(
        self, scene: mi.Scene, sampler: mi.Sampler, posed: list[PosedField], rays: Rays
    ) -> list[mi.Color3f]:
        """Return what the radiance of each field is multiplied by, (3, n) each.

        ``E / pi`` for relit fields, the ratio of irradiances for the others; 1 on
        rays that do not meet the field. Not differentiable.

        Raises:
            InputError: the scene has no emitter.
        """
        check_emitters(scene)
        shapes = [geometry(item) for item in posed]
        objects = [s for s, relit in zip(shapes, self.relit, strict=True) if relit]
        result = []
        for shape, relit in zip(shapes, self.relit, strict=True):
            surface = expected_surface(shape, rays, self.stop)
            surface.point += CLEARANCE * shape.lattice(mi.Float(1)) * surface.normal
            with dr.suspend_grad():
                lit, unshadowed = self._irradiance(scene, sampler, surface, objects)
            gain = lit / dr.pi if relit else ratio(lit, unshadowed)
            result.append(dr.select(surface.active, gain, 1))
        return result

    def behind(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        posed: list[PosedField],
        ray: mi.Ray3f,
        active: mi.Bool,
    ) -> mi.Color3f:
        """Return the ratio of irradiances at the scene's nearest surface, (3, n).

        1 where there is no surface, or one that emits. Not differentiable.
        """
        if len(scene.shapes()) == 0:
            return mi.Color3f(1)
        pairs = zip(posed, self.relit, strict=True)
        objects = [geometry(item) for item, relit in pairs if relit]
        with dr.suspend_grad():
            if has_passages(scene):  # from just before the surface that stops the ray
                met = nearest_surface(scene, ray, active)
                active = active & (met < dr.inf)  # others see the sky
                ray = mi.Ray3f(ray(dr.select(active, (1 - 1e-4) * met, 0)), ray.d)
            si = scene.ray_intersect(ray, active)
            facing = dr.dot(si.n, ray.d) < 0
            normal = dr.select(facing, mi.Vector3f(si.n), -mi.Vector3f(si.n))
            # `==` compares the pointer of each lane, which `is` would not
            shadowed = si.is_valid() & (si.emitter(scene, active) == None)  # noqa: E711
            surface = Surface(si.p, normal, active & shadowed)
            lit, unshadowed = self._irradiance(scene, sampler, surface, objects)
            return dr.select(surface.active, ratio(lit, unshadowed), 1)

    @dr.syntax
    def _irradiance(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        surface: Surface,
        objects: list[PosedField],
    ) -> tuple[mi.Color3f, mi.Color3f]:
        """Estimate irradiance (3, n), linear RGB: with the objects and without."""
        it = dr.zeros(mi.SurfaceInteraction3f, dr.width(surface.point))
        it.p, it.n = surface.point, mi.Normal3f(surface.normal)
        active = mi.Bool(surface.active)
        # A lattice under a random shift: evenly spread, each point uniform by itself.
        shift, turn = sampler.next_2d(active), sampler.next_1d(active)
        walks = has_passages(scene)
        k = mi.UInt32(0)
        lit = mi.Color3f(0)
        unshadowed = mi.Color3f(0)
        while k < self.samples:
            i = mi.Float(k)
            sample = mi.Point2f((shift.x + i) / self.samples, shift.y + i * _GOLDEN)
            sample -= dr.floor(sample)
            wavelengths, weight = _wavelengths(turn + i * _SILVER)
            it.wavelengths = wavelengths
            ds, light = scene.sample_emitter_direction(
                it, sample, test_visibility=not walks, active=active
            )
            cosine = dr.maximum(dr.dot(surface.normal, ds.d), 0)
            light = _to_rgb(light * weight, wavelengths) * (cosine / self.samples)
            is_far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            end = dr.select(is_far, dr.inf, ds.dist)
            used = active & (dr.max(dr.abs(light)) > 0)
            if walks:  # Mitsuba's shadow rays end at what light passes straight
                used &= dr.isinf(nearest_surface(scene, it.spawn_ray_to(ds.p), used))
            passed = _transmittance(
                objects,
                Rays(it.p, ds.d, end, jitter=mi.Float(0.5), active=used),
                self.stop,
            )
            unshadowed += dr.select(used, light, 0)
            lit += dr.select(used, light * passed, 0)
            k += 1
        return dr.maximum(lit, 0), unshadowed


def check_emitters(scene: mi.Scene) -> None:
    """Raise InputError unless a scene has an emitter."""
    if len(scene.emitters()) == 0:
        raise InputError(
            "relit: the scene has no emitter that could light the object; add one "
            "(sunsky, directional, envmap, ...) or remove relit"
        )


def ratio(lit: mi.Color3f, unshadowed: mi.Color3f) -> mi.Color3f:
    """Divide irradiances, each (3, n); 1 where no light is.

    In spectral variants the colour of a sum of few wavelengths may leave [0, 1].
    """
    is_lit = unshadowed > 0
    share = lit / dr.select(is_lit, unshadowed, 1)
    return mi.Color3f(dr.select(is_lit, dr.clip(share, 0, 1), 1))


def _transmittance(objects: list[PosedField], rays: Rays, stop: float) -> mi.Float:
    passed = mi.Float(1)
    for item in objects:
        passed *= 1 - march(item, rays, stop).opacity
    return passed


def _wavelengths(sample: mi.Float) -> tuple[Any, Any]:
    """Sample wavelengths (nm) of spectral variants, and their weights."""
    if not mi.is_spectral:
        return mi.Color0f(), mi.Spectrum(1)
    shifted = mi.Spectrum(*[sample + i / 4 for i in range(4)])
    return mi.sample_rgb_spectrum(shifted - dr.floor(shifted))


def _to_rgb(light: Any, wavelengths: Any) -> mi.Color3f:
    """Turn a spectrum into linear Rec. 709."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(light, wavelengths)
    if mi.is_monochromatic:
        return mi.Color3f(light.x)
    return mi.Color3f(light)
