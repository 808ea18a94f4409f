"""Images of a Mitsuba scene through cameras on vehicles, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.arrays import differentiates_rays, vjp
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.rays import Gain
from mi_nerfattack.rollout.camera import SceneCamera, pose_of
from mi_nerfattack.rollout.parameters import CollectsRays
from mi_nerfattack.rollout.sensor import Observation


class SceneImages:
    """A scene as its integrator renders it, through one camera at a time.

    Args:
        scene: metric, z up.
        integrator: of the protocol of Mitsuba's `RBIntegrator`.

    Attributes:
        collector: the integrator, where it marches rays of several frames together,
            as a `field_integrator` does.

    Raises:
        InputError: the integrator has no such protocol.
    """

    def __init__(self, scene: mi.Scene, integrator: Any) -> None:
        if not differentiates_rays(integrator):
            raise InputError(
                f"scene: its integrator {integrator.class_name()} cannot be "
                "differentiated ray by ray; use field_integrator or prb"
            )
        self.scene = scene
        self.integrator = integrator
        self.collector: CollectsRays | None = None
        if isinstance(integrator, CollectsRays):
            self.collector = integrator

    def observe(
        self, camera: SceneCamera, state: Any, step: int, gains: Sequence[Gain]
    ) -> Observation:
        """Render the images of a batch.

        Args:
            camera: the camera on the vehicles.
            state: (m, n), as of :meth:`AbstractSensor.observe`.
            step: as of :meth:`AbstractSensor.observe`.
            gains: the light on all layers; none for the light of the capture.
        """
        count = dr.width(state)
        # From the state to rays, to their radiance, and to linear pixels
        with dr.suspend_grad():
            sampler, *view = camera.rays(pose_of(state), count, step)
            linear, state_out = self._render(
                camera, sampler, view, state_in=None, gains=gains
            )
        return _observation(
            camera, linear, state_out, view=view, count=count, step=step
        )

    def keep(self, observation: Observation) -> Any:
        """Keep what the integrator has to, or else the pixels and its whole state."""
        if self.collector is not None:
            return self.collector.keep(observation.integrator_state)
        return observation.linear, observation.integrator_state

    def restore(
        self,
        camera: SceneCamera,
        state: Any,
        step: int,
        record: Any,
        gains: Sequence[Gain],
    ) -> Observation:
        """Return what :meth:`observe` gave, from what :meth:`keep` kept of it."""
        count = dr.width(state)
        # The same rays again, whose fields are not marched again
        with dr.suspend_grad():
            sampler, *view = camera.rays(pose_of(state), count, step)
            if self.collector is None:
                linear, inner = record
            else:
                dr.eval(view)
                inner = self.collector.restore(view[0], record, gains)
                linear, inner = self._render(camera, sampler, view, inner)
        return _observation(camera, linear, inner, view=view, count=count, step=step)

    def vjp(
        self,
        camera: SceneCamera,
        observation: Observation,
        state: Any,
        d_image: Any,
        attached: bool,
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`."""
        # From the developed image back to the radiance of each sample
        d_linear = vjp(dr.linear_to_srgb, observation.linear, _colours(d_image))
        leaf, view = None, observation.view
        count, step = dr.width(state), observation.step
        if attached:
            self.check_attached()
            leaf = pose_of(state)
            dr.enable_grad(leaf)
            _, *view = camera.rays(leaf, count, step)
        with dr.suspend_grad():
            ray, weight = view
            δL = camera.spread(d_linear) * dr.detach(weight)
            # From the radiance to the parameters and, through its rays, to the state
            with dr.isolate_grad():
                sampler = camera.sampler(count, step)
                state_in = observation.integrator_state
                self._sample(
                    camera,
                    dr.ADMode.Backward,
                    sampler,
                    ray=ray,
                    δL=δL,
                    state_in=state_in,
                )
        if leaf is None:
            return None
        result = dr.grad(leaf)
        dr.eval(result)
        return result

    def check_attached(self) -> None:
        """Raise InputError where images have no derivative by the state."""
        if self.collector is None:
            raise InputError(
                f"attached: {type(self.integrator).__name__} has no derivative by the "
                "camera; set attached to false, or show fields by a field_integrator"
            )
        self.collector.check_camera(self.scene)

    def _render(
        self,
        camera: SceneCamera,
        sampler: mi.Sampler,
        view: Any,
        state_in: Any,
        gains: Sequence[Gain] = (),
    ) -> tuple[mi.Color3f, Any]:
        """Return linear pixels, and the integrator's state."""
        ray, weight = view
        mode = dr.ADMode.Primal
        colour, _, _, state_out = self._sample(
            camera, mode, sampler, ray=ray, δL=None, state_in=state_in, gains=gains
        )
        linear = camera.pixels(colour * weight)
        dr.eval(linear, state_out)
        return linear, state_out

    def _sample(
        self,
        camera: SceneCamera,
        mode: dr.ADMode,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        δL: Any = None,
        state_in: Any = None,
        gains: Sequence[Gain] = (),
    ) -> tuple[Any, ...]:
        lit = {"gains": gains} if gains else {}
        return self.integrator.sample(
            mode=mode,
            scene=self.scene,
            sampler=sampler,
            ray=ray,
            depth=mi.UInt32(0),
            δL=δL,
            δaovs=None,
            state_in=state_in,
            active=mi.Bool(True),
            frozen=True,
            **lit,
        )


def _observation(
    camera: SceneCamera,
    linear: mi.Color3f,
    integrator_state: Any,
    view: Any,
    count: int,
    step: int,
) -> Observation:
    width, height = camera.size
    with dr.suspend_grad():
        pixels = dr.ravel(dr.linear_to_srgb(linear))
        dr.eval(pixels)
    image = mi.TensorXf(pixels, (count, height, width, 3))
    return Observation(
        image, step, linear, integrator_state=integrator_state, view=view
    )


def _colours(image: Any) -> mi.Color3f:
    """Return the pixels of an image (n, height, width, 3) as (3, n height width)."""
    index = dr.arange(mi.UInt32, dr.width(image.array) // 3)
    return dr.gather(mi.Color3f, image.array, index)
