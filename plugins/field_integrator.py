"""The integrator `field_integrator`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.plugins.field_volume import AbstractFieldVolume
from mi_nerfattack.plugins.properties import (
    Mask,
    background,
    read_composite,
    read_nested,
    read_stop,
    refuse_nested,
)
from mi_nerfattack.plugins.splat_background import SplatBackgroundVolume
from mi_nerfattack.render.backdrop import only_fields
from mi_nerfattack.render.composite import Seen
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.lighting.relight import LIGHT_SAMPLES, Relighting
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.surroundings import nearest_surface


class FieldIntegrator(mi.ad.integrators.common.RBIntegrator):
    r"""
    .. _integrator-field_integrator:

    Composite of fields (:monosp:`field_integrator`)
    ------------------------------------------------

    .. pluginparameters::

     * - (Nested plugin)
       - |volume|
       - ``grid_field``, ``ngp_field``, ``splat_background``; one or more
       - |exposed|, |differentiable|

     * - (Nested plugin)
       - |integrator|
       - Renders the surfaces and lights behind, for instance ``path``.
         (Default: none)

     * - composite
       - |string|
       - :monosp:`interleaved` or :monosp:`depth`. (Default: :monosp:`interleaved`)

     * - stop
       - |float|
       - Transmittance at which a ray ends. (Default: 1e-6)

     * - jitter
       - |bool|
       - Random instead of middle sample positions. (Default: |false|)

     * - relit_samples
       - |int|
       - Light samples a ray, for each field and for what lies behind; only if a field
         is ``relit``. (Default: 16)

     * - hide_emitters, max_depth, rr_depth, block_size, samples_per_pass, timeout
       - |int|
       - Read by Mitsuba's own base classes, and without effect here: those of the
         nested integrator count

    The integrator marches every camera ray through the nested fields up to the nearest
    surface of the scene: ``L = I + (1 - a) L_b``. Behind the fields, the ray shows what
    a nested integrator sees, or the background of the first field that has one.

    The composite is ``interleaved`` (one march, ``sigma = sum sigma_k``, ``L = sum
    sigma_k L_k / sigma``) or ``depth`` (each field alone, folded front to back by
    expected depth, ``I = I_f + (1 - a_f) I_b``, A.4 to A.6); they agree where fields do
    not overlap. A ``splat_background`` is a layer of ``depth`` alone, and takes no
    derivatives.

    AOVs: ``opacity``, ``depth`` (metres, of the composite), and per field ``<id>.R``,
    ``<id>.G``, ``<id>.B`` (premultiplied), ``<id>.A`` and ``<id>.Z``: of the field's
    share of the image (``interleaved``) or of the field alone (``depth``). The depth of
    a pixel is the mean of its samples weighted by their opacity, infinite where none
    is above 0; ``mi.render`` returns it, the film alone holds depth times opacity.

    .. tabs::
        .. code-tab:: xml

            <integrator type="field_integrator">
                <volume type="ngp_field" id="scene">
                    <string name="filename" value="field.safetensors"/>
                </volume>
                <volume type="grid_field" id="object">
                    <string name="filename" value="hydrant.safetensors"/>
                </volume>
            </integrator>

        .. code-tab:: python

            {
                "type": "field_integrator",
                "scene": {"type": "ngp_field", "filename": "field.safetensors"},
                "object": {"type": "grid_field", "filename": "hydrant.safetensors"},
            }

    Volumes with ``relit`` true are inserted objects, which the scene's emitters light.
    Their radiance is the reflectance of a diffuse surface at their expected depth:
    ``L = radiance E / pi``. They throw shadows on all other fields and surfaces. See
    ``render.lighting.relight`` for what this leaves out. It costs several marches per
    field.

    Differentiable in primal, forward and backward mode with respect to the fields'
    parameters, of radiance only. Not differentiable: AOVs, the camera, surfaces, and
    the light on relit objects, which is a constant.
    Monochromatic variants show luminance; spectral ones the linear spectrum of
    ``render.lighting.spectrum``; AOVs are RGB everywhere.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        spectrum.prepare()
        self.stop = read_stop(props)
        self.composite = read_composite(props)
        self.jitter = bool(props.get("jitter", False))
        kinds = (AbstractFieldVolume, SplatBackgroundVolume)
        self.volumes, others = read_nested(props, "field_integrator", kinds)
        is_first = bool(others) and isinstance(others[0], mi.SamplingIntegrator)
        refuse_nested(
            others[1:] if is_first else others,
            "field_integrator",
            ", splat_background, and one sampling integrator such as path",
        )
        self.posed = [volume.posed for volume in self.volumes]
        self.composite.check(self.posed)
        self.behind = others[0] if is_first else None
        samples: Any = props.get("relit_samples", LIGHT_SAMPLES)
        relit = tuple(volume.relit for volume in self.volumes)
        relighting = Relighting(relit, int(samples), self.stop)
        if any(relit):
            only_fields(
                self.posed, "relit objects throw no shadow on it", "set relit to false"
            )
        self.relighting = relighting if any(relit) else None
        self._has_aovs = True

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the fields under their ids."""
        for volume in self.volumes:
            cb.put(volume.id(), volume, mi.ParamFlags.Differentiable)

    def aov_names(self) -> list[str]:
        """Name the arbitrary output variables."""
        if not self._has_aovs:
            return []
        layers = [f"{v.id()}.{c}" for v in self.volumes for c in "RGBAZ"]
        return ["opacity", "depth", *layers]

    def render(
        self,
        scene: mi.Scene,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render the image with its AOVs."""
        image = super().render(scene, sensor, seed, spp, develop, evaluate)
        return self._with_depths(image)

    def _with_depths(self, image: mi.TensorXf) -> mi.TensorXf:
        """Divide the depth moments, which filters can average, by the opacities."""
        height, width, count = image.shape
        names = self.aov_names()
        first = count - len(names)
        pixel = count * dr.arange(mi.UInt32, height * width)
        values = mi.Float(image.array)
        ids = [volume.id() for volume in self.volumes]
        pairs = [("opacity", "depth"), *((f"{i}.A", f"{i}.Z") for i in ids)]
        for name, moment in pairs:
            opacity = dr.gather(
                mi.Float, image.array, pixel + first + names.index(name)
            )
            target = pixel + first + names.index(moment)
            hit = opacity > 0
            depth = dr.gather(mi.Float, image.array, target) / dr.select(
                hit, opacity, 1
            )
            dr.scatter(values, dr.select(hit, depth, dr.inf), target)
        return mi.TensorXf(values, image.shape)

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: mi.TensorXf,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> None:
        """Accumulate gradients; those of AOVs are ignored."""
        count = _film(scene, sensor).base_channels_count()
        with self._without_aovs():
            super().render_backward(
                scene, params, grad_in[..., :count], sensor, seed, spp
            )

    def render_forward(
        self,
        scene: mi.Scene,
        params: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Render the image's tangent; that of AOVs is zero."""
        with self._without_aovs():
            tangent = super().render_forward(scene, params, sensor, seed, spp)
        height, width, count = tangent.shape
        total = count + len(self.aov_names())
        full = dr.zeros(mi.Float, height * width * total)
        index = dr.arange(mi.UInt32, height * width * count)
        pixel = index // count
        dr.scatter(full, tangent.array, pixel * total + index - pixel * count)
        return mi.TensorXf(full, (height, width, total))

    @contextmanager
    def _without_aovs(self) -> Iterator[None]:
        # Mitsuba 3.9 multiplies AOVs by the sensor's spectral weight there and fails.
        self._has_aovs = False
        try:
            yield
        finally:
            self._has_aovs = True

    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        depth: Any = None,
        δL: Any = None,
        δaovs: Any = None,
        state_in: Any = None,
        active: Mask = True,
    ) -> tuple[Any, mi.Bool, list[mi.Float], Any]:
        """Integrate one ray a lane; see Mitsuba's ``RBIntegrator.sample``."""
        del depth, δaovs
        ray = mi.Ray3f(dr.detach(ray))
        active = mi.Bool(active)
        jitter = sampler.next_1d(active) if self.jitter else mi.Float(0.5)
        t_max = nearest_surface(scene, ray, active)
        rays = Rays(ray.o, ray.d, t_max, jitter, active)
        if state_in is None:  # primal mode, or forward mode, which comes without
            rays.gains, shadow = self._relight(scene, sampler, ray, rays)
            seen = self.composite.render(self.posed, rays, self.stop)
            behind = self._behind(scene, sampler, ray, active)
            state_in = seen, self._darken(behind, shadow, ray), rays.gains
        seen, behind, rays.gains = state_in
        if mode == dr.ADMode.Primal:
            radiance = self._over(seen.total, rays, behind, ray.wavelengths)
            return radiance, active, self._aovs(seen), state_in
        if mode == dr.ADMode.Backward:
            self._backward(rays, seen, behind, ray.wavelengths, δL)
            return δL, active, [], None
        tangent = self._forward(rays, seen, behind, ray.wavelengths)
        # Mitsuba writes this into the tangent of alpha, which is zero.
        valid = mi.Bool(False)
        return tangent, valid, [], None

    def _backward(
        self, rays: Rays, seen: Seen, behind: Any, wavelengths: Any, δL: Any
    ) -> None:
        with dr.resume_grad():
            total = seen.total.copy()
            dr.enable_grad(total)
            radiance = self._over(total, rays, behind, wavelengths)
            dr.backward_from(dr.sum(radiance * δL))
            cotangent = dr.grad(total)
        self.composite.backward(self.posed, rays, seen, cotangent, self.stop)

    def _forward(self, rays: Rays, seen: Seen, behind: Any, wavelengths: Any) -> Any:
        tangent = self.composite.forward(self.posed, rays, seen, self.stop)
        with dr.resume_grad():
            total = seen.total.copy()
            dr.enable_grad(total)
            dr.set_grad(total, tangent)
            radiance = self._over(total, rays, behind, wavelengths)
            return dr.forward_to(radiance, flags=dr.ADFlag.ClearEdges)

    def _behind(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
    ) -> Any:
        """Return the spectrum that the nested integrator sees; None without one."""
        if self.behind is None:
            return None
        ray = mi.RayDifferential3f(ray)
        return self.behind.sample(scene, sampler, ray, active=active)[0]

    def _relight(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, rays: Rays
    ) -> tuple[list[mi.Color3f], mi.Color3f | None]:
        """Return the fields' gains, and that of what lies behind; none if not relit."""
        if self.relighting is None:
            return [], None
        gains = self.relighting.gains(scene, sampler, self.posed, rays)
        if self.behind is None:
            return gains, None
        shadow = self.relighting.behind(scene, sampler, self.posed, ray, rays.active)
        return gains, shadow

    def _darken(self, behind: Any, shadow: mi.Color3f | None, ray: mi.Ray3f) -> Any:
        if shadow is None:
            return behind
        return behind * spectrum.reflectance(shadow, ray.wavelengths)

    def _over(self, total: March, rays: Rays, behind: Any, wavelengths: Any) -> Any:
        """Lay the fields over what is behind, as a spectrum."""
        passed = 1 - total.opacity
        if behind is not None:
            return spectrum.emission(total.radiance, wavelengths) + passed * behind
        fields = [v for v in self.volumes if isinstance(v, AbstractFieldVolume)]
        sky = background(fields, rays.direction) & (rays.t_max == dr.inf)
        return spectrum.emission(total.radiance + passed * sky, wavelengths)

    def _aovs(self, seen: Seen) -> list[mi.Float]:
        if not self._has_aovs:
            return []
        result = [seen.total.opacity, seen.total.moment]
        for layer in seen.layers:
            result += [*layer.radiance, layer.opacity, layer.moment]
        return result

    def to_string(self) -> str:
        """Describe the checked parameters."""
        names = ", ".join(volume.id() for volume in self.volumes)
        kind = type(self.composite).__name__
        return f"FieldIntegrator[fields=({names}), {kind}, stop={self.stop}]"


def _film(scene: mi.Scene, sensor: Any) -> mi.Film:
    return (scene.sensors()[sensor] if isinstance(sensor, int) else sensor).film()


mi.register_integrator("field_integrator", lambda props: FieldIntegrator(props))
