"""Rendering of an integrator's samples onto a film, and its derivatives."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError


class FilmIntegrator(mi.ad.integrators.common.RBIntegrator):
    """Integrator whose samples have an opacity, and AOVs that are no plain means.

    Mitsuba's own `RBIntegrator` writes 0 or 1 into alpha, multiplies AOVs by the
    sensor's spectral weight, and drops the derivatives of both. Members define
    ``sample`` as it does, and the three methods below.
    """

    def film_channels(self) -> list[str]:
        """Name what :meth:`splats` returns: the film's channels after the colour."""
        raise NotImplementedError

    def splats(self, state: Any) -> tuple[mi.Float, list[mi.Float]]:
        """Return alpha and the film's AOVs of each ray, (n,) each.

        Args:
            state: what ``sample`` returned in primal mode.
        """
        raise NotImplementedError

    def developed(self, image: mi.TensorXf) -> mi.TensorXf:
        """Turn a film's channels into those of the image; differentiable."""
        return image

    def differentiating(
        self, scene: mi.Scene, mode: dr.ADMode
    ) -> AbstractContextManager[None]:
        """Prepare to differentiate by the parameters that have gradients enabled.

        Args:
            scene: that is rendered.
            mode: forward or backward.
        """
        del scene, mode
        return nullcontext()

    def render(
        self,
        scene: mi.Scene,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render the image with its AOVs; see ``mi.render``."""
        del develop, evaluate
        with dr.suspend_grad():
            view = _View(self, scene, sensor, seed=seed, spp=spp)
            colour, state = view.trace(view.sampler)
            return view.develop(colour, *self.splats(state))

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: mi.TensorXf,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> None:
        """Accumulate gradients; see ``mi.render``."""
        del params
        with self.differentiating(scene, dr.ADMode.Backward), dr.suspend_grad():
            view = _View(self, scene, sensor, seed=seed, spp=spp)
            colour, state = view.trace(view.sampler.clone())
            alpha, aovs = self.splats(state)
            # Film and division, by automatic differentiation
            with dr.resume_grad():
                leaves = dr.detach((colour, alpha, aovs))
                dr.enable_grad(leaves)
                image = view.develop(*leaves)
                dr.set_grad(image, grad_in)
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
                δL, *δsplats = dr.grad(leaves)
            view.film.clear()
            # Fields, nested integrator and camera
            view.trace(
                view.sampler, dr.ADMode.Backward, δL, δsplats=δsplats, state_in=state
            )

    def render_forward(
        self,
        scene: mi.Scene,
        params: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Render the image's tangent; see ``mi.render``."""
        del params
        with self.differentiating(scene, dr.ADMode.Forward), dr.suspend_grad():
            view = _View(self, scene, sensor, seed=seed, spp=spp)
            colour, state = view.trace(view.sampler.clone())
            alpha, aovs = self.splats(state)
            tangent, t_splats = view.trace(
                view.sampler, dr.ADMode.Forward, state_in=state
            )
            with dr.resume_grad():
                leaves = dr.detach((colour, alpha, aovs))
                dr.enable_grad(leaves)
                dr.set_grad(leaves, (tangent, *t_splats))
                image = view.develop(*leaves)
                return dr.forward_to(image, flags=dr.ADFlag.ClearEdges)


class _View:
    """Rays of one rendering, and the film that they end on."""

    def __init__(
        self,
        integrator: FilmIntegrator,
        scene: mi.Scene,
        sensor: Any,
        seed: Any,
        spp: int,
    ) -> None:
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        self.integrator, self.scene, self.film = integrator, scene, sensor.film()
        names = integrator.film_channels()
        if names and mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            raise InputError(
                f"film {self.film.class_name()}: has channels of its own, and none "
                "for AOVs; set aovs to false, or use hdrfilm"
            )
        self.sampler, self.spp = integrator.prepare(sensor, seed, spp, names)
        self.ray, self.weight, self.position = integrator.sample_rays(
            scene, sensor, self.sampler
        )

    def trace(
        self,
        sampler: mi.Sampler,
        mode: dr.ADMode = dr.ADMode.Primal,
        δL: Any = None,
        δsplats: Any = None,
        state_in: Any = None,
    ) -> tuple[Any, Any]:
        """Sample all rays: colour and state, or tangents of colour and splats."""
        samples = self.integrator.sample(
            mode=mode,
            scene=self.scene,
            sampler=sampler,
            ray=self.ray,
            depth=mi.UInt32(0),
            δL=δL,
            δaovs=None,
            δsplats=δsplats,  # pyright: ignore[reportCallIssue]  # of members
            state_in=state_in,
            active=mi.Bool(True),
        )
        return samples[0], samples[3]

    def develop(self, colour: Any, alpha: mi.Float, aovs: list) -> mi.TensorXf:
        """Splat rays and divide by their weights; differentiable."""
        block = self.film.create_block()
        block.set_coalesce(block.coalesce() and self.spp >= 4)
        block.put(self.position, self._channels(block, colour, alpha, aovs=aovs))
        self.film.put_block(block)
        return self.integrator.developed(self.film.develop())

    def _channels(
        self, block: mi.ImageBlock, colour: Any, alpha: mi.Float, aovs: list
    ) -> list[mi.Float]:
        """Return what a film wants of rays: colours, weights and AOVs."""
        value, wavelengths = colour * self.weight, self.ray.wavelengths
        if mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            count = block.channel_count()
            return self.film.prepare_sample(
                value, wavelengths, count, weight=1.0, alpha=alpha
            )
        if mi.is_spectral:
            value = mi.spectrum_to_srgb(value, wavelengths)
        rgb = [value.x] * 3 if mi.is_monochromatic else [*value]
        has_alpha = mi.has_flag(self.film.flags(), mi.FilmFlags.Alpha)
        return [*rgb, *([alpha] if has_alpha else []), mi.Float(1), *aovs]
