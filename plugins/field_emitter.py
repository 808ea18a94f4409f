"""The emitter `field_emitter`."""

from __future__ import annotations

from typing import Any, NoReturn

import drjit as dr
import mitsuba as mi

from mi_nerfattack.plugins import field_volume as shared
from mi_nerfattack.plugins.properties import (
    Mask,
    background,
    read_composite,
    read_nested,
    read_stop,
    refuse_nested,
)
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.lighting.attached import attached
from mi_nerfattack.render.rays import Rays


class FieldEmitter(mi.Emitter):
    r"""
    .. _emitter-field_emitter:

    Fields behind the surface of a shape (:monosp:`field_emitter`)
    --------------------------------------------------------------

    .. pluginparameters::

     * - (Nested plugin)
       - |volume|
       - ``grid_field``, ``ngp_field``; one or more
       - |exposed|, |differentiable|

     * - composite
       - |string|
       - :monosp:`interleaved` or :monosp:`depth`, as of ``field_integrator``.
         (Default: :monosp:`interleaved`)

     * - stop
       - |float|
       - Transmittance at which a ray ends. (Default: 1e-6)

     * - sampling_weight
       - |float|
       - Share of emitter samples, relative to the scene's other emitters.
         (Default: 1)

     * - to_world
       - |transform|
       - Read by Mitsuba of every emitter, and without effect: volumes and shape have
         their own

    Radiance that leaves the surface of a closed shape along a ray is the composite of
    the nested fields along that ray (see ``field_integrator``), over the background
    of the first field that has one. Seen from outside, the march starts on the
    surface; seen from inside, it starts at the ray's origin and ends on the surface.
    So stock integrators (``path``, ``direct``) show the fields, and light other
    surfaces with them: directions are sampled on the shape, as the stock ``area``
    emitter does.

    .. tabs::
        .. code-tab:: xml

            <shape type="cube">
                <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
                <emitter type="field_emitter">
                    <volume type="grid_field" id="object">
                        <string name="filename" value="hydrant.safetensors"/>
                    </volume>
                </emitter>
            </shape>

        .. code-tab:: python

            {
                "type": "cube",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}},
                "emitter": {
                    "type": "field_emitter",
                    "object": {"type": "grid_field", "filename": "hydrant.safetensors"},
                },
            }

    Next-event estimation and multiple importance sampling work as in the stock
    ``area`` emitter: it samples points on the shape by area. So a small bright field in
    a large shape lights surfaces without bias, but with noise.

    Differentiable in forward and backward mode with respect to the fields' parameters
    under ``path``, ``direct`` and ``prb``, and in backward mode with respect to
    ``to_world`` of the fields. The sensor and the shape have no derivative here. In
    forward mode, call ``dr.forward_from`` before rendering: a ``dr.forward`` after it
    returns 0.
    Mitsuba 3.9's ``prb`` fails in forward mode with any emitter in spectral variants.

    Excluded, so fields are missing there or too bright:

    - The shape should enclose the fields, whose own boxes end the march, and carry a
      black BSDF: it is opaque, so what lies behind it is not seen (use
      ``field_integrator`` for that).
    - Seen from inside, fields lie between the shape and where the ray started: the
      camera or the last surface, be it a ``null`` one. Other surfaces inside the
      shape are seen without the fields in front of them.
    - Light tracing from the shape (``ptracer``) is refused.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        spectrum.prepare()
        self.stop = read_stop(props)
        self.composite = read_composite(props)
        kinds = (shared.AbstractFieldVolume,)
        self.volumes, others = read_nested(props, "field_emitter", kinds)
        refuse_nested(others, "field_emitter")
        self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the fields under their ids."""
        for volume in self.volumes:
            cb.put(volume.id(), volume, mi.ParamFlags.Differentiable)

    def eval(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> Any:
        """Evaluate the radiance that leaves towards ``si.wi``, (channels, n)."""
        # From inside, rays end on the surface; from outside, they start there
        direction = -si.to_world(si.wi)
        inside = dr.dot(direction, si.n) > 0
        origin = dr.select(inside, si.p - si.t * direction, si.p)
        t_max = dr.select(inside, si.t, dr.inf)
        rays = Rays(
            origin, direction, t_max, jitter=mi.Float(0.5), active=mi.Bool(active)
        )
        # The fields, and what they let through of the sky behind them
        posed = [volume.posed for volume in self.volumes]
        radiance, opacity = attached(self.composite, posed, rays, stop=self.stop)
        radiance += (1 - opacity) * background(self.volumes, direction)
        return spectrum.emission(radiance, si.wavelengths) & active

    def sample_ray(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse to trace light from the shape."""
        raise NotImplementedError(
            "field_emitter: cannot trace light from it as ptracer does; use path, "
            "direct, prb or volpath"
        )

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: Mask = True
    ) -> tuple[mi.DirectionSample3f, Any]:
        """Sample a point of the shape seen from ``it``."""
        ds = self.get_shape().sample_direction(it, sample, active)
        active = mi.Bool(active) & (ds.pdf > 0)
        ds.emitter = mi.EmitterPtr(self)
        value = self.eval(self._towards(ds, it), active)
        return ds, dr.select(active, value / dr.select(active, ds.pdf, 1), 0)

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Mask = True
    ) -> mi.Float:
        """Return the density of :meth:`sample_direction`, 1/steradian."""
        return dr.select(active, self.get_shape().pdf_direction(it, ds, active), 0)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Mask = True
    ) -> Any:
        """Evaluate the radiance that arrives at ``it`` from ``ds``."""
        return self.eval(self._towards(ds, it), active)

    def _towards(
        self, ds: mi.DirectionSample3f, it: mi.Interaction3f
    ) -> mi.SurfaceInteraction3f:
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p, si.n, si.t = ds.p, ds.n, ds.dist
        si.wavelengths = it.wavelengths
        si.sh_frame = mi.Frame3f(mi.Vector3f(ds.n))
        si.wi = si.to_local(-ds.d)
        return si

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Return the union of the fields' boxes."""
        box = mi.ScalarBoundingBox3f()
        for volume in self.volumes:
            box.expand(volume.bbox())
        return box

    def to_string(self) -> str:
        """Describe the checked parameters."""
        names = ", ".join(volume.id() for volume in self.volumes)
        return f"FieldEmitter[fields=({names}), stop={self.stop}]"


mi.register_emitter("field_emitter", lambda props: FieldEmitter(props))
