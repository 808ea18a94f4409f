"""What a policy sees: sensors that turn vehicle states into images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.colour import linear_to_srgb
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera import Camera, CameraMount, generate_rays, mount_pose
from mi_nerfattack.render.composite import depth_composite
from mi_nerfattack.render.march import STOP, March, march, march_derivative
from mi_nerfattack.render.posed import PosedField


@dataclass(frozen=True)
class Observation:
    """One image a vehicle, and what is needed to look closer at it.

    Attributes:
        image: tensor (n, height, width, 3), sRGB in [0, 1], evaluated.
        layers: one march a field, scene first; empty where there are none.
        origin: (3, n height width) ray origins, metres.
        direction: (3, n height width) ray directions.
        step: the step that seeded the jitter.
    """

    image: Any
    layers: tuple[March, ...] = ()
    origin: Any = None
    direction: Any = None
    step: int = 0


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
    """Camera in a scene field with objects: the surrogate simulator.

    One ray a pixel through its centre; the `depth` composite; behind everything the
    background of the scene's field. All fields are marched in one kernel.

    Cost of an observation: one march. Cost of a product: one march derivative over
    the rays that meet an object (over all rays and fields when attached).

    Args:
        scene: the scene's field in the world.
        objects: fields with textures, posed in the world; may be empty.
        camera: intrinsics.
        mount: pose on the vehicle.
        jitter_seed: seed of per-ray sample positions, renewed each step and replayed
            by products; None places samples at the middle of their intervals.
        stop: transmittance at which rays end.
    """

    def __init__(
        self,
        scene: PosedField,
        objects: list[PosedField],
        camera: Camera,
        mount: CameraMount | None = None,
        jitter_seed: int | None = None,
        stop: float = STOP,
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
        self.renders = 0

    def observe(self, state: Any, step: int) -> Observation:
        """Render the composite; see :meth:`AbstractSensor.observe`."""
        count = dr.width(state)
        origin, direction = self._rays(dr.detach(state))
        jitter = self._jitter(step, dr.width(direction))
        t_max = dr.opaque(mi.Float, dr.inf)
        layers = tuple(
            march(posed, origin, direction, t_max, jitter, mi.Bool(True), self.stop)
            for posed in (self.scene, *self.objects)
        )
        pixels = self._develop(layers, direction)
        dr.eval(layers, pixels, origin, direction)
        self.renders += count
        image = self._tensor(pixels, count)
        return Observation(image, layers, origin, direction, step)

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`."""
        layers = [_leaf(layer) for layer in observation.layers]
        direction = mi.Vector3f(observation.direction)
        if attached:
            dr.enable_grad(direction)
        pixels = self._develop(layers, direction)
        count = dr.width(pixels)
        index = 3 * dr.arange(mi.UInt32, count)
        dr.backward_from(
            sum(
                (
                    pixels[c] * dr.gather(mi.Float, d_image.array, index + c)
                    for c in range(3)
                ),
                mi.Float(0),
            )
        )
        cotangents = [_gradient(layer) for layer in layers]
        if attached:
            return self._attached(observation, state, cotangents, dr.grad(direction))
        dr.eval(cotangents)
        for posed, primal, cotangent in zip(
            self.objects, observation.layers[1:], cotangents[1:], strict=True
        ):
            self._scatter(posed, observation, primal, cotangent)
        return None

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

    def _rays(self, state: Any) -> tuple[mi.Point3f, mi.Vector3f]:
        mount = self.mount
        origin, columns = mount_pose(
            (mi.Float(state[0]), mi.Float(state[1]), mi.Float(state[2])),
            mount.height_m,
            mount.forward_m,
            mount.pitch_deg,
        )
        dr.eval(origin, columns)
        return generate_rays(self.camera, origin, columns, dr.width(state))

    def _jitter(self, step: int, count: int) -> mi.Float:
        if self.jitter_seed is None:
            return dr.opaque(mi.Float, 0.5)
        seed = dr.opaque(mi.UInt32, self.jitter_seed)
        key = mi.sample_tea_32(seed, dr.opaque(mi.UInt32, step))[0]
        return mi.sample_tea_float32(key, dr.arange(mi.UInt32, count))

    def _develop(self, layers: Any, direction: mi.Vector3f) -> mi.Color3f:
        total = depth_composite(list(layers))
        behind = self.scene.field.background(direction)
        return linear_to_srgb(total.radiance + (1 - total.opacity) * behind)

    def _tensor(self, pixels: mi.Color3f, count: int) -> mi.TensorXf:
        shape = (count, self.camera.height, self.camera.width, 3)
        return mi.TensorXf(dr.ravel(pixels), shape)

    def _scatter(
        self, posed: PosedField, seen: Observation, primal: March, cotangent: March
    ) -> None:
        """Differentiate the march of one object over the rays that meet it."""
        index = dr.compress(primal.opacity > 0)
        if dr.width(index) == 0:
            return

        def pick(value: Any) -> Any:
            return dr.gather(type(value), value, index)

        jitter = self._jitter(seen.step, dr.width(seen.direction))
        if dr.width(jitter) > 1:
            jitter = pick(jitter)
        march_derivative(
            dr.ADMode.Backward,
            posed,
            pick(seen.origin),
            pick(seen.direction),
            dr.opaque(mi.Float, dr.inf),
            jitter,
            mi.Bool(True),
            pick(primal),
            pick(cotangent),
            self.stop,
        )
        dr.eval(dr.grad(posed.field.packed))

    def _attached(
        self, seen: Observation, state: Any, cotangents: list[March], d_direction: Any
    ) -> Any:
        """Differentiate all marches, then the rays by the state."""
        d_origin = mi.Vector3f(0)
        jitter = self._jitter(seen.step, dr.width(seen.direction))
        for posed, primal, cotangent in zip(
            (self.scene, *self.objects), seen.layers, cotangents, strict=True
        ):
            _, by_origin, by_direction = march_derivative(
                dr.ADMode.Backward,
                posed,
                seen.origin,
                seen.direction,
                dr.opaque(mi.Float, dr.inf),
                jitter,
                mi.Bool(True),
                primal,
                cotangent,
                self.stop,
            )
            d_origin += by_origin
            d_direction += by_direction
        dr.eval(d_origin, d_direction)
        leaf = type(state)(dr.detach(state))
        dr.enable_grad(leaf)
        origin, direction = self._rays(leaf)
        dr.backward_from(dr.dot(origin, d_origin) + dr.dot(direction, d_direction))
        result = dr.grad(leaf)
        dr.eval(result, [dr.grad(posed.field.packed) for posed in self.objects])
        return result


def _leaf(layer: March) -> March:
    copy = March(
        mi.Color3f(layer.radiance), mi.Float(layer.opacity), mi.Float(layer.moment)
    )
    dr.enable_grad(copy)
    return copy


def _gradient(layer: March) -> March:
    return March(dr.grad(layer.radiance), dr.grad(layer.opacity), dr.grad(layer.moment))
