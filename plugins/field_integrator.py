"""The integrator `field_integrator`."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.plugins import limits
from mi_nerfattack.plugins.collector import FrozenComposite, RayCollector
from mi_nerfattack.plugins.field_volume import AbstractFieldVolume
from mi_nerfattack.plugins.film import FilmIntegrator
from mi_nerfattack.plugins.nested import (
    FieldChannels,
    Sampled,
    State,
    lay_over,
    look,
    push_forward,
    sample_nested,
)
from mi_nerfattack.plugins.properties import (
    Mask,
    read_composite,
    read_nested,
    read_stop,
    refuse_nested,
)
from mi_nerfattack.plugins.splat_background import SplatBackgroundVolume
from mi_nerfattack.render.backdrop import only_fields
from mi_nerfattack.render.composite import Marches
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.lighting.relight import LIGHT_SAMPLES, Relighting
from mi_nerfattack.render.rays import Gain, Rays
from mi_nerfattack.render.scene_march import nearest_surface


class FieldIntegrator(FilmIntegrator):
    r"""
    .. _integrator-field_integrator:

    Composite of fields (:monosp:`field_integrator`)
    ------------------------------------------------

    .. pluginparameters::

     * - (Nested plugin)
       - |volume|
       - ``grid_field``, ``ngp_field``, ``brick_field``, ``splat_background``; one or
         more
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

     * - aovs
       - |bool|
       - Render opacity, depth and layers, too: see below. (Default: |false|)

     * - relit_samples
       - |int|
       - Light samples a ray, for each field and for what lies behind; only if a field
         is ``relit``. (Default: 16)

     * - hide_emitters, max_depth, rr_depth, block_size, samples_per_pass, timeout
       - |int|
       - Read by Mitsuba's own base classes, and without effect here: those of the
         nested integrator count

    The integrator marches every camera ray through the nested fields up to the nearest
    surface of the scene: ``L = I + (1 - a) L_b``. It passes surfaces that light passes
    straight: ``null``, ``thindielectric`` and the transparent parts of a ``mask``.
    Behind the fields, the ray shows what a nested integrator sees, with what such
    surfaces reflect, or the background of the first field that has one.

    The composite is ``interleaved`` (one march, ``sigma = sum sigma_k``, ``L = sum
    sigma_k L_k / sigma``) or ``depth`` (each field alone, folded front to back by
    expected depth, ``I = I_f + (1 - a_f) I_b``, A.4 to A.6); they agree where fields do
    not overlap. A ``splat_background`` is a layer of ``depth`` alone.

    With ``aovs``, the image has more channels, which ``aov_names()`` lists: ``opacity``
    and ``depth`` (metres) of the composite of fields, without surfaces. Each field adds
    ``<id>.R``, ``<id>.G``, ``<id>.B`` (premultiplied), ``<id>.A`` and ``<id>.Z``: of
    the field's share of the image (``interleaved``) or of the field alone (``depth``).
    The depth of a pixel is the mean of its samples weighted by their opacity, infinite
    where none is above 0. The film itself holds ``moment`` and ``<id>.moment``, depth
    times opacity, in the place of depths. AOVs of the nested integrator come last, for
    example the depth of surfaces. The film's alpha is the opacity, over that of the
    nested integrator.

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

    Differentiable in forward and backward mode with respect to the fields' parameters.
    So is all that a nested ``prb``, ``prbvolpath`` or other differentiable integrator
    of Mitsuba's shows: BSDFs, bitmaps and lights, and fields that an emitter shares.
    In backward mode with respect to ``to_world`` of fields, and to the sensor where
    fields are alone in the scene. AOVs are differentiated, too, except the shares of
    single fields in ``interleaved``. What has no derivative raises an error: a nested
    integrator without that interface (``path``), moving surfaces, which occlude
    fields, and all but ``colour`` where a field is relit, whose light is constant.
    Monochromatic variants show luminance; spectral ones the linear spectrum of
    ``render.lighting.spectrum``; AOVs are RGB everywhere.
    """

    def __init__(self, props: mi.Properties, fewest: int = 1) -> None:
        super().__init__(props)
        spectrum.prepare()
        self.stop = read_stop(props)
        self.composite = read_composite(props)
        self.jitter = bool(props.get("jitter", False))
        has_aovs = bool(props.get("aovs", False))
        kinds = (AbstractFieldVolume, SplatBackgroundVolume)
        self.volumes, others = read_nested(props, "field_integrator", kinds, fewest)
        is_first = bool(others) and isinstance(others[0], mi.SamplingIntegrator)
        refuse_nested(
            others[1:] if is_first else others,
            "field_integrator",
            ", splat_background, and one sampling integrator such as path",
        )
        ids = tuple(volume.id() for volume in self.volumes)
        self.channels = FieldChannels(ids if has_aovs else ())
        self.posed = [volume.posed for volume in self.volumes]
        self.composite.check(self.posed)
        self.behind = others[0] if is_first else None
        #: Whether derivatives are asked for by what the nested integrator renders.
        self.differentiates_behind = False
        self.frozen = FrozenComposite(self.composite, self.posed, self.stop)
        self.collector = RayCollector(self.composite, self.posed, self.stop)
        samples: Any = props.get("relit_samples", LIGHT_SAMPLES)
        relit = tuple(volume.relit for volume in self.volumes)
        relighting = Relighting(relit, int(samples), self.stop)
        if any(relit):
            only_fields(
                self.posed, "relit objects throw no shadow on it", "set relit to false"
            )
        self.relighting = relighting if any(relit) else None

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the fields under their ids, and the nested integrator."""
        for volume in self.volumes:
            cb.put(volume.id(), volume, mi.ParamFlags.Differentiable)
        if self.behind is not None:
            cb.put("behind", self.behind, mi.ParamFlags.Differentiable)

    def aov_names(self) -> list[str]:
        """Name the arbitrary output variables, those of the nested integrator last."""
        behind = [] if self.behind is None else list(self.behind.aov_names())
        return [*self.channels.names(), *behind]

    def film_channels(self) -> list[str]:
        """See :meth:`FilmIntegrator.film_channels`."""
        names = self.channels.film_names()
        return [*names, *self.aov_names()[len(names) :]]

    def splats(self, state: State) -> tuple[mi.Float, list[mi.Float]]:
        """See :meth:`FilmIntegrator.splats`."""
        alpha = state.marches.total.opacity
        if state.valid is not None:
            alpha = dr.select(state.valid, 1, alpha)
        return alpha, [*self.channels.of_film(state.marches), *state.aovs]

    def developed(self, image: mi.TensorXf) -> mi.TensorXf:
        """See :meth:`FilmIntegrator.developed`."""
        after = len(self.aov_names()) - len(self.channels.names())
        return self.channels.develop(image, after)

    @contextmanager
    def differentiating(self, scene: mi.Scene, mode: dr.ADMode) -> Iterator[None]:
        """Prepare to differentiate by the parameters that have gradients enabled.

        Raises:
            InputError: a derivative that is not computed; the message names what is.
        """
        before = self.differentiates_behind
        self.differentiates_behind = limits.check(self, scene)
        with ExitStack() as stack:
            # Dr.Jit passes no tangents on inside an operation: see `tangents`
            for volume in self.volumes if mode == dr.ADMode.Forward else []:
                stack.enter_context(volume.tangents())
            try:
                yield
            finally:
                self.differentiates_behind = before

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
        δsplats: Any = None,
        frozen: bool = False,
        gains: Sequence[Gain] = (),
        **kwargs: Any,
    ) -> tuple[Any, mi.Bool, list[mi.Float], Any]:
        """Integrate one ray per lane; see Mitsuba's ``RBIntegrator.sample``.

        A film gives cotangents of :meth:`splats` as ``δsplats``, and finds tangents in
        the place of the state. ``frozen``: replay recordings, where nothing is being
        recorded. ``gains``: light on each field.
        """
        del depth, kwargs
        is_primal = mode == dr.ADMode.Primal
        # Inside `moment`, which leaves the derivatives to Dr.Jit
        if is_primal and not frozen and (leaves := limits.attached(scene)):
            where = "inside another integrator; take the fields out of it"
            limits.check_ray(ray, where)
            call = {"scene": scene, "sampler": sampler, "ray": ray, "active": active}
            return *dr.custom(Sampled, self, call, leaves), None
        attached, ray = ray, mi.Ray3f(dr.detach(ray))
        active = mi.Bool(active)
        jitter = sampler.next_1d(active) if self.jitter else mi.Float(0.5)
        # Where the fields end: the first surface that light does not pass straight
        t_max = nearest_surface(scene, ray, active)
        rays = Rays(ray.o, ray.d, t_max, jitter, active, list(gains))
        # I and a of the fields (A.1 to A.6), and L_b behind them
        if state_in is None:  # primal mode, or forward mode, which comes without
            inner = sampler if is_primal else sampler.clone()
            state_in = look(self, scene, inner, ray=ray, rays=rays, frozen=frozen)
        state: State = state_in
        rays.gains = state.gains
        valid = state.marches.total.opacity > 0
        if state.valid is not None:
            valid |= state.valid
        if is_primal:  # L = I + (1 - a) L_b
            radiance = lay_over(self, state.marches.total, rays, state.behind, ray)
            aovs = [*self.channels.of_sample(state.marches), *state.aovs]
            return radiance, valid, aovs, state
        if mode == dr.ADMode.Backward:  # from dJ/dL to the parameters, and to the ray
            self._backward(scene, sampler, attached, rays, state, δL, δsplats, δaovs)
            return δL, valid, [], None
        # Forward: from tangents of the parameters to that of L
        limits.check_ray(attached, "in forward mode; use dr.backward")
        tangent, t_splats = push_forward(self, scene, sampler, ray, rays, state)
        return tangent, valid, [], t_splats

    def _backward(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        rays: Rays,
        state: State,
        δL: Any,
        δsplats: Any,
        δaovs: Any,
    ) -> None:
        """Accumulate the gradients of all that the rays show."""
        by_camera = limits.is_attached(ray)
        if by_camera:
            limits.check_camera(self, scene, "camera")
        # From the colour back to the fields, to what is behind, and to the sky
        with dr.resume_grad():
            leaf = state.copy()
            direction = mi.Vector3f(rays.direction)
            dr.enable_grad(leaf.marches, leaf.behind, direction)
            lit = replace(rays, direction=direction)
            radiance = lay_over(self, leaf.marches.total, lit, leaf.behind, ray)
            pairs = []
            if δsplats is not None:
                alpha, others = self.splats(leaf)
                pairs = [(alpha, δsplats[0]), *zip(others, δsplats[1], strict=True)]
            if δaovs:
                pairs += zip(self.channels.of_sample(leaf.marches), δaovs, strict=False)
            dr.backward_from(sum((x * δ for x, δ in pairs), dr.sum(radiance * δL)))
            cotangent = dr.grad(leaf.marches)
            if not pairs:  # the colour depends on the total alone
                cotangent = Marches(cotangent.total)
            δbehind = None if leaf.behind is None else dr.grad(leaf.behind)
            by_sky = dr.grad(direction) if by_camera else None
        # From dJ/dL_b to BSDFs, bitmaps and lights
        if self.differentiates_behind:
            sample_nested(
                self.behind,
                dr.ADMode.Backward,
                scene,
                sampler=sampler,
                ray=mi.Ray3f(dr.detach(ray)),
                active=rays.active,
                δL=δbehind,
                state_in=state.inner,
            )
        # From dJ/dI and dJ/da to densities and colours: a march again, perhaps later
        if not by_camera and not any(item.has_pose_gradients for item in self.posed):
            self.collector.add(rays, state.marches, cotangent)
            return
        self._backward_rays(ray, rays, state, cotangent, by_sky)

    def _backward_rays(
        self, ray: mi.Ray3f, rays: Rays, state: State, cotangent: Marches, by_sky: Any
    ) -> None:
        """March fields, poses and, with `by_sky`, the camera back at once."""
        layers = [
            k
            for k, item in enumerate(self.posed)
            if by_sky is not None or item.has_gradients or item.has_pose_gradients
        ]
        gradients = self.collector.by_rays(rays, state.marches, cotangent, layers)
        # A field that moves is seen as by rays that move against it
        for k, by_rays in zip(layers, gradients, strict=True):
            self.posed[k].backward_pose(rays, by_rays)
        # The camera moves all rays alike, and with them what they see of the sky
        if by_sky is not None:
            by_origin = sum((part.origin for part in gradients), mi.Vector3f(0))
            by_direction = sum((part.direction for part in gradients), by_sky)
            with dr.resume_grad():
                dr.backward_from(dr.dot(ray.o, by_origin) + dr.dot(ray.d, by_direction))

    def start_gradient(self, scene: mi.Scene, keys: Collection[str]) -> None:
        """Collect the rays of backward passes until :meth:`finish_gradient`.

        Args:
            scene: that is rendered.
            keys: of `mi.traverse(scene)`, the parameters to differentiate by.

        Raises:
            InputError: a derivative that is not computed.
        """
        self.collector.clear()
        self.differentiates_behind = limits.check(self, scene, keys)
        self.collector.waits = True

    def finish_gradient(self) -> None:
        """Accumulate the gradients of all collected rays."""
        self.collector.finish()

    def stop_gradient(self) -> None:
        """Collect no more, and forget the rays that wait."""
        self.collector.clear()
        self.differentiates_behind = self.collector.waits = False

    def check_camera(self, scene: mi.Scene) -> None:
        """Raise InputError where rays have no derivative by the camera."""
        limits.check_camera(self, scene, limits.ATTACHED)

    def keep(self, state: State) -> State:
        """Return a state of which only that is left which is costly."""
        gains = state.gains if self.relighting else []
        return replace(state, marches=self.composite.keep(state.marches), gains=gains)

    def restore(self, ray: mi.Ray3f, record: State, gains: Sequence[Gain]) -> State:
        """Return the state of rays that :meth:`keep` was given."""
        rays = Rays(ray.o, ray.d, gains=record.gains or list(gains))
        marches = self.composite.restore(self.posed, rays, record.marches, self.stop)
        return replace(record, marches=marches, gains=rays.gains)

    def to_string(self) -> str:
        """Describe the checked parameters."""
        kind, ids = type(self.composite).__name__, [v.id() for v in self.volumes]
        return f"FieldIntegrator[fields=({', '.join(ids)}), {kind}, stop={self.stop}]"


mi.register_integrator("field_integrator", lambda props: FieldIntegrator(props))
