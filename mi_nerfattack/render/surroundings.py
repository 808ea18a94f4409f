"""What lies around and behind fields: surfaces and lights of a Mitsuba scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.render.camera.intrinsics import Camera, ray_lengths
from mi_nerfattack.render.rays import Rays

#: Why and what to do where the camera's path is asked for.
ATTACHED = (
    "surfaces and a nested integrator are constants of a frame, without derivatives by "
    "the camera; set attached to false, or take them out of the scene"
)


@dataclass
class Ends:
    """Where rays end, and what is seen there: constants of every derivative.

    Attributes:
        t_max: (n,), metres; infinite where there is no surface.
        radiance: (3, n), linear, behind all fields.
    """

    t_max: mi.Float = field(default_factory=lambda: mi.Float(dr.inf))
    radiance: mi.Color3f = field(default_factory=lambda: mi.Color3f(0))


@dataclass(frozen=True)
class Clip:
    """Distances along the optical axis between which a camera sees, metres.

    Attributes:
        near_m: where rays start.
        far_m: where they end, as far as surfaces are concerned; fields go on.
    """

    near_m: float = 0.0
    far_m: float = float("inf")


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


class Surroundings:
    """Surfaces of a scene, and what an integrator sees of them, behind fields.

    They depend on the rays alone, and on the seed: none is differentiated. Cost of a
    look: one intersection a ray, and `spp` samples of the integrator.

    Args:
        scene: its shapes and emitters count; its integrator does not.
        behind: renders what rays see behind the fields; None for the background of a
            field, where no surface is in front of it.
        sampler: of the samples of `behind`, as many as its sample count.
        camera: whose images the rays make up.
        clip: between which surfaces are seen.
        seed: of the samples, renewed each step.
    """

    def __init__(
        self,
        scene: mi.Scene,
        behind: Any,
        sampler: mi.Sampler,
        camera: Camera,
        clip: Clip,
        seed: int = 0,
    ) -> None:
        if behind is not None and not mi.is_rgb:
            raise SetupError(
                f"variant {mi.variant()!r}: a nested integrator behind the fields of a "
                "sensor needs colour; set MI_NERFATTACK_VARIANT=llvm_ad_rgb"
            )
        self.scene = scene
        self.behind = behind
        self.seed = seed
        self._sampler = sampler
        reach = (clip.far_m - clip.near_m) * ray_lengths(camera).ravel()
        self._reach = mi.Float(reach.tolist())

    def through(self, camera: Camera, clip: Clip) -> Surroundings:
        """Return what another camera sees of the same."""
        parts = self.scene, self.behind, self._sampler
        return Surroundings(*parts, camera, clip, self.seed)

    def see(self, rays: Rays, step: Any, sky: mi.Color3f) -> Ends:
        """Return where rays end, and what is seen there.

        Args:
            rays: n rays, image by image.
            step: `mi.UInt32`, index of the control period.
            sky: (3, n), behind everything where there is no nested integrator.

        Returns:
            evaluated arrays.
        """
        with dr.suspend_grad():
            index = dr.arange(mi.UInt32, dr.width(rays.direction))
            ray = mi.Ray3f(rays.origin, rays.direction)
            pixel = index % dr.width(self._reach)
            ray.maxt = dr.gather(mi.Float, self._reach, pixel)
            t_max = nearest_surface(self.scene, ray, mi.Bool(True))
            t_max = dr.select(ray.maxt > 0, t_max, dr.inf)  # of the width of the rays
            if self.behind is None:
                ends = Ends(t_max, sky & (t_max == dr.inf))
            else:
                ends = Ends(t_max, self._sample(self.behind, ray, step))
            dr.eval(ends)
        return ends

    def _sample(self, behind: Any, ray: mi.Ray3f, step: Any) -> mi.Color3f:
        """Average samples of the nested integrator, (3, n)."""
        sampler = self._sampler.clone()
        spp, count = sampler.sample_count(), dr.width(ray.d)
        sampler.set_samples_per_wavefront(spp)
        seed = mi.sample_tea_32(dr.opaque(mi.UInt32, self.seed), step)[0]
        sampler.seed(seed, count * spp)
        index = dr.arange(mi.UInt32, count * spp) // spp
        origin, direction = (dr.gather(type(v), v, index) for v in (ray.o, ray.d))
        each = mi.RayDifferential3f(origin, direction)
        each.maxt = dr.gather(mi.Float, ray.maxt, index)
        seen = behind.sample(self.scene, sampler, each)[0]
        return mi.Color3f(*[dr.block_sum(mi.Float(c), spp) / spp for c in seen])
