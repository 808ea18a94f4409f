"""What a policy sees: sensors that turn vehicle states into images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.colour import linear_to_srgb
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera import Camera, CameraMount, generate_rays, mount_pose
from mi_nerfattack.render.composite import (
    AbstractComposite,
    DepthComposite,
    Seen,
    Task,
)
from mi_nerfattack.render.march import STOP, March, Rays
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.frozen import freeze_method


@dataclass(frozen=True)
class Observation:
    """One image a vehicle, and what is needed to look closer at it.

    Attributes:
        image: tensor (n, height, width, 3), sRGB in [0, 1], evaluated.
        seen: the composite, one ray a pixel, its layers scene first; None where the
            sensor has no fields.
        rays: n height width rays; None where the sensor traces none.
    """

    image: Any
    seen: Seen | None = None
    rays: Rays | None = None


class AbstractSensor(ABC):
    """Camera on a vehicle in some world."""

    @abstractmethod
    def observe(self, state: Any, step: int) -> Observation:
        """Render what vehicles see.

        Args:
            state: (3, n), metres and radians; taken as a constant.
            step: index of the time step, from 0; seeds what is random.
        """


class AbstractDifferentiableSensor(AbstractSensor):
    """Sensor whose image can be differentiated by its textures and by the state."""

    @abstractmethod
    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """Accumulate the texture's gradient and return the state's.

        Args:
            observation: from :meth:`observe` with the same state and step.
            state: (3, n), as given to :meth:`observe`.
            d_image: derivative of the objective by the image, of its shape.
            attached: whether to differentiate by the state.

        Returns:
            (3, n) derivative by the state; None when not `attached`.
        """

    @abstractmethod
    def start_gradient(self) -> None:
        """Set the accumulated gradients of the textures to zero."""

    @abstractmethod
    def texture_gradients(self) -> list[Any]:
        """Return what has been accumulated, one tensor (n_vertices, 3) an object."""


class FieldSensor(AbstractDifferentiableSensor):
    """Camera in a scene with objects: the surrogate simulator.

    One ray a pixel through its centre; behind everything the background of the
    scene's field. All fields are marched in one kernel, for all vehicles together.

    Cost of an observation: one march. Cost of a product: one march derivative over
    the rays that meet an object (over all rays and fields when attached).

    Args:
        scene: the scene's field in the world, or a backdrop; that one needs the depth
            composite, and has no attached derivatives.
        objects: fields with textures, posed in the world; may be empty.
        camera: intrinsics.
        mount: pose on the vehicle.
        jitter_seed: seed of per-ray sample positions, renewed each step and replayed
            by products; None places samples at the middle of their intervals.
        stop: transmittance at which rays end.
        composite: how fields become one colour; `DepthComposite` by default.
    """

    def __init__(
        self,
        scene: Layer,
        objects: list[PosedField],
        camera: Camera,
        mount: CameraMount | None = None,
        jitter_seed: int | None = None,
        stop: float = STOP,
        composite: AbstractComposite | None = None,
    ) -> None:
        for posed in objects:
            if not isinstance(posed.field, GridField):
                raise TypeError(f"objects: {posed.field.kind}; grid fields are needed")
        self.scene = scene
        self.objects = list(objects)
        self.camera = camera
        self.mount = mount or CameraMount()
        self.jitter_seed = jitter_seed
        self.stop = stop
        self.composite = composite or DepthComposite()
        self.composite.check(self._fields)
        self.renders = 0
        # Tracing these in Python takes longer than running them.
        self._frozen_render = freeze_method(self._render, self._state)
        self._frozen_cotangent = freeze_method(self._cotangent, self._state)
        self._frozen_accumulate = freeze_method(self._accumulate, self._state)
        self._frozen_rays = freeze_method(self._backward_rays, self._state)

    def observe(self, state: Any, step: int) -> Observation:
        """Render the composite; see :meth:`AbstractSensor.observe`."""
        count = dr.width(state)
        key = dr.opaque(mi.UInt32, step)
        pixels, seen, rays = self._frozen_render(dr.detach(state), key, count)
        self.renders += count
        return Observation(self._tensor(pixels, count), seen, rays)

    def _render(
        self, state: Any, step: mi.UInt32, count: int
    ) -> tuple[mi.Color3f, Seen, Rays]:
        origin, direction = self._rays(state, count)
        jitter = self._jitter(step, dr.width(direction))
        far, active = dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Bool, True)
        rays = Rays(origin, direction, far, jitter, active)
        seen = self.composite.render(self._fields, rays, self.stop)
        return self._develop(seen.total, direction), seen, rays

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`."""
        rays, seen = observation.rays, observation.seen
        assert rays is not None and seen is not None
        cotangent, d_direction = self._frozen_cotangent(
            seen.total, rays.direction, d_image.array
        )
        if attached:
            return self._attached(observation, state, cotangent, d_direction)
        for task in self.composite.tasks(self._fields, rays, seen, cotangent):
            self._frozen_accumulate(task)
        dr.eval([dr.grad(posed.field.packed) for posed in self.objects])
        return None

    def _cotangent(
        self, total: March, direction: mi.Vector3f, d_image: mi.Float
    ) -> tuple[March, mi.Vector3f]:
        """Differentiate by the composite and, for the sky, by the direction."""
        total, direction = total.copy(), mi.Vector3f(direction)
        dr.enable_grad(total, direction)
        pixels = self._develop(total, direction)
        index = 3 * dr.arange(mi.UInt32, dr.width(pixels))
        weights = [dr.gather(mi.Float, d_image, index + c) for c in range(3)]
        dr.backward_from(dr.dot(pixels, mi.Color3f(*weights)))
        return dr.grad(total), dr.grad(direction)

    def _accumulate(self, task: Task) -> None:
        posed = [self._fields[k] for k in task.fields]
        self.composite.accumulate(posed, task, self.stop)

    def _backward_rays(
        self, rays: Rays, seen: Seen, cotangent: March
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        fields = self._fields
        return self.composite.backward_rays(fields, rays, seen, cotangent, self.stop)

    def _state(self, *arguments: Any) -> list[Any]:
        """Return what frozen functions read or depend on beside their arguments."""
        # Recordings hold literals of one image's size; a task has none.
        sizes = [dr.width(x) for x in arguments if not isinstance(x, Task)]
        state = [posed.state() for posed in self._fields]
        return [self.composite, self.stop, sizes, state]

    def start_gradient(self) -> None:
        """Make every object's packed grid a fresh leaf with gradient zero."""
        for posed in self.objects:
            leaf = mi.Float(dr.detach(posed.field.packed))
            dr.enable_grad(leaf)
            posed.field.packed = leaf
            dr.set_grad(posed.field.packed, dr.opaque(mi.Float, 0, dr.width(leaf)))

    def texture_gradients(self) -> list[Any]:
        """Return the accumulated gradient of each texture, (n_vertices, 3)."""
        return [
            posed.field.texture_gradient(dr.grad(posed.field.packed))
            for posed in self.objects
        ]

    def _rays(self, state: Any, count: int) -> tuple[mi.Point3f, mi.Vector3f]:
        mount = self.mount
        origin, columns = mount_pose(
            (mi.Float(state[0]), mi.Float(state[1]), mi.Float(state[2])),
            mount.height_m,
            mount.forward_m,
            mount.pitch_deg,
        )
        dr.eval(origin, columns)
        return generate_rays(self.camera, origin, columns, count)

    def _jitter(self, step: mi.UInt32, count: int) -> mi.Float:
        if self.jitter_seed is None:
            return dr.opaque(mi.Float, 0.5)
        seed = dr.opaque(mi.UInt32, self.jitter_seed)
        key = mi.sample_tea_32(seed, step)[0]
        return mi.sample_tea_float32(key, dr.arange(mi.UInt32, count))

    @property
    def _fields(self) -> list[Layer]:
        return [self.scene, *self.objects]

    def _develop(self, total: March, direction: mi.Vector3f) -> mi.Color3f:
        behind = self.scene.background(direction)
        return linear_to_srgb(total.radiance + (1 - total.opacity) * behind)

    def _tensor(self, pixels: mi.Color3f, count: int) -> mi.TensorXf:
        shape = (count, self.camera.height, self.camera.width, 3)
        return mi.TensorXf(dr.ravel(pixels), shape)

    def _attached(
        self, seen: Observation, state: Any, cotangent: March, d_direction: Any
    ) -> Any:
        """Differentiate all marches, then the rays by the state."""
        d_origin, by_direction = self._frozen_rays(seen.rays, seen.seen, cotangent)
        d_direction += by_direction
        dr.eval(d_origin, d_direction)
        leaf = type(state)(dr.detach(state))
        dr.enable_grad(leaf)
        origin, direction = self._rays(leaf, dr.width(leaf))
        dr.backward_from(dr.dot(origin, d_origin) + dr.dot(direction, d_direction))
        result = dr.grad(leaf)
        dr.eval(result, [dr.grad(posed.field.packed) for posed in self.objects])
        return result
