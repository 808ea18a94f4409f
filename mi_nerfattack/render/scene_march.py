"""Marches through a scene's field, whose parameters are constants, and its surfaces."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.cpu.ngp import PackedNGP
from mi_nerfattack.fields.ngp import NGPField
from mi_nerfattack.render.march import integrate, march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain, March, Rays
from mi_nerfattack.render.walk import Walk, clear_distance


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
    if has_passages(scene):
        return _walk_through(scene, ray, active)
    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    return dr.select(hit.is_valid(), hit.t, dr.inf)


def has_passages(scene: mi.Scene) -> bool:
    """Tell whether light passes a surface of a scene straight."""
    null = mi.BSDFFlags.Null
    return any(mi.has_flag(shape.bsdf().flags(), null) for shape in scene.shapes())


@dr.syntax
def _walk_through(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
    """Do what :func:`nearest_surface` does where surfaces let light pass straight."""
    part = mi.Ray3f(ray)
    behind = mi.Float(0)
    nearest = mi.Float(dr.inf)
    searching = mi.Bool(active)
    while searching:
        si = scene.ray_intersect(
            part, mi.RayFlags.All, coherent=False, active=searching
        )
        met = searching & si.is_valid()
        # The first surface that no light passes straight ends the search
        passed = dr.max(si.bsdf().eval_null_transmission(si, met)) > 0
        nearest = dr.select(met & ~passed, behind + si.t, nearest)
        searching = met & passed
        # Other rays go on behind the surface, with the length that is left
        behind += dr.select(searching, si.t, 0)
        part = si.spawn_ray(part.d)
        part.maxt = ray.maxt - behind
    return nearest


class AbstractSceneMarch(ABC):
    """A way to march rays through one field whose parameters are constants.

    Args:
        posed: the field.
        stop: transmittance below which a ray ends.
    """

    def __init__(self, posed: PosedField, stop: float) -> None:
        self.posed = posed
        self.stop = stop
        self._frozen = freeze_method(self._record, self._state)

    def march(self, rays: Rays) -> March:
        """Integrate radiance, opacity and moment; as `render.march.march`.

        Args:
            rays: n rays, with gains for one field or none; neighbours one after the
                other, or it takes longer.

        Returns:
            the march, (n,), evaluated.
        """
        last = dr.opaque(mi.UInt32, dr.width(rays.direction) - 1)
        return self._frozen(_opaque(rays), last)

    def _record(self, rays: Rays, last: mi.UInt32) -> March:
        with dr.suspend_grad():
            # Bundles of rays cross empty space first; then each ray marches alone
            return self._march(rays, clear_distance(self.posed, rays, last))

    @abstractmethod
    def _march(self, rays: Rays, clear: mi.Float) -> March:
        """March rays, which meet empty cells alone for so many metres (n,)."""

    @abstractmethod
    def _state(self, rays: Rays, last: mi.UInt32) -> list[Any]:
        """Return what :meth:`_march` reads or was compiled for, for `drjit.freeze`."""


def scene_march(posed: PosedField, stop: float) -> AbstractSceneMarch:
    """Choose the fastest way to march a field on this backend.

    Args:
        posed: the field.
        stop: transmittance below which a ray ends.
    """
    on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
    field = posed.field
    if on_cpu and isinstance(field, NGPField) and PackedNGP.suits(field):
        return PackedMarch(posed, stop)
    return FieldMarch(posed, stop)


class FieldMarch(AbstractSceneMarch):
    """Any field, any backend: `render.march.march`, recorded once."""

    def _march(self, rays: Rays, clear: mi.Float) -> March:
        (posed,) = rays.light([self.posed])
        return march(posed, rays, self.stop, clear=clear)

    def _state(self, rays: Rays, last: mi.UInt32) -> list[Any]:
        del last
        return [self, self.stop, dr.width(rays.direction), self.posed.state()]


class PackedMarch(AbstractSceneMarch):
    """An NGP on a CPU, from a copy of its parameters that is faster to read.

    Same positions, occupancy and termination as `render.march.march`, and the same
    result except for rounding, in about half of the time. Where the transmittance
    equals `stop` to the last digits, a ray may take one sample more or fewer: one in
    300,000 did, and `stop` bounds the difference. Costs a copy of the table.

    Args:
        posed: an NGP that `PackedNGP` suits.
        stop: transmittance below which a ray ends.
    """

    def __init__(self, posed: PosedField, stop: float) -> None:
        super().__init__(posed, stop)
        assert isinstance(posed.field, NGPField)
        self._field = posed.field
        self._packed = PackedNGP(posed.field)

    def march(self, rays: Rays) -> March:
        """See :meth:`AbstractSceneMarch.march`."""
        if not self._packed.is_current():  # a parameter has changed since the copy
            self._packed = PackedNGP(self._field)
        return super().march(rays)

    def _march(self, rays: Rays, clear: mi.Float) -> March:
        view = self._packed.view(dr.normalize(self.posed.turn(rays.direction)))
        walk, active = Walk.start(self.posed, rays, clear)
        result = integrate(
            [self.posed],
            walk,
            active,
            evaluate=[self._evaluate],
            towards=[view],
            stop=self.stop,
        ).march()
        # The table has the light of the capture, so the gain comes after the march
        for (gain,) in [rays.gains] if rays.gains else []:
            result.radiance *= gain.colour
        return result

    def _evaluate(
        self, point: mi.Point3f, view: Any, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        density, colour = self._packed.eval(point, view, active)
        return self.posed.in_world(density), colour

    def _state(self, rays: Rays, last: mi.UInt32) -> list[Any]:
        del last
        sizes = [dr.width(rays.direction), self._field.layout]
        return [self, self.stop, sizes, self._packed.state(), self.posed.state()]


def _opaque(rays: Rays) -> Rays:
    """Return rays that are known in memory, so that no number becomes code."""
    rays = Rays(
        mi.Point3f(dr.detach(rays.origin)),
        mi.Vector3f(dr.detach(rays.direction)),
        t_max=mi.Float(dr.detach(rays.t_max)),
        jitter=mi.Float(dr.detach(rays.jitter)),
        active=mi.Bool(rays.active),
        gains=[Gain(mi.Color3f(dr.detach(x.colour)), x.row) for x in rays.gains],
    )
    dr.make_opaque(rays)
    return rays
