"""Any Mitsuba scene as what policies see: the integrator is the renderer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.differentiate import vjp
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.vertex_colours import gradient, start_gradient
from mi_nerfattack.render.camera.conventions import from_mitsuba
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.offset import offset_gradient, offset_pose
from mi_nerfattack.rollout.scene_camera import SceneCamera
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor, Observation


@runtime_checkable
class CollectsRays(Protocol):
    """An integrator that marches the rays of several frames together."""

    def start_gradient(self, scene: mi.Scene, keys: list[str]) -> None:
        """Collect rays from now on; InputError where a key has no derivative."""

    def finish_gradient(self) -> None:
        """Accumulate the gradients of all collected rays."""

    def stop_gradient(self) -> None:
        """Collect no more, and forget the rays that wait."""


class SceneSensor(AbstractDifferentiableSensor):
    """Camera on a vehicle that sees a Mitsuba scene as its integrator renders it.

    An image is that of `mi.render` with the scene's sensor on the vehicle, developed
    by a box filter: lens, clip distances, film size and samples per pixel are the
    sensor's, its pose is not. The derivative is the integrator's own ``sample`` in
    backward mode, with the random numbers of the forward pass. So the integrator needs
    the protocol of Mitsuba's `RBIntegrator`, as `field_integrator`, `prb`, `prbvolpath`
    and `volprim_rf_basic` have it. Lens and film are constants of the derivative, and
    so is the shape of surfaces, since visibility has no derivative here.

    Args:
        scene: metric, z up.
        mount: pose of the camera on the vehicle.
        params: keys of `mi.traverse(scene)` to differentiate by, for instance
            ``hydrant.colour``; a rollout that is called with parameters chooses them
            by itself.
        sensor: index of the scene's sensor.
        seed: of all random numbers, renewed each control period.

    Raises:
        InputError: no such key or sensor, or an integrator without that protocol.
        SetupError: the variant is spectral.
    """

    def __init__(
        self,
        scene: mi.Scene,
        mount: CameraMount | None = None,
        params: Sequence[str] = (),
        sensor: int = 0,
        seed: int = 0,
    ) -> None:
        if mi.is_spectral:
            raise SetupError(
                f"variant {mi.variant()!r}: a policy's camera has three colours; call "
                "mitsuba.set_variant('llvm_ad_rgb')"
            )
        count = len(scene.sensors())
        if not 0 <= sensor < count:
            raise InputError(f"sensor: {sensor}; the scene has {count}, from 0 on")
        self.scene = scene
        self.integrator: Any = scene.integrator()
        if not isinstance(self.integrator, mi.ad.integrators.common.RBIntegrator):
            raise InputError(
                f"scene: its integrator {self.integrator.class_name()} cannot be "
                "differentiated ray by ray; use field_integrator or prb"
            )
        self.camera = SceneCamera(scene.sensors()[sensor], mount or CameraMount(), seed)
        #: A `field_integrator`, which marches rays of several frames together.
        self._collector: CollectsRays | None = None
        if isinstance(self.integrator, CollectsRays):
            self._collector = self.integrator
        self._before: dict[str, Any] = {}
        self._leaves: dict[str, Any] = {}
        self._arrays: list[tuple[GridField, mi.Float]] = []
        self.params: Any = mi.traverse(scene)
        self.select(params)
        self.renders: int = 0

    def select(self, keys: Sequence[str]) -> None:
        """Differentiate by other parameters.

        Args:
            keys: of `mi.traverse(scene)`.

        Raises:
            InputError: there is no such parameter, or it has no derivative here.
        """
        for key in keys:
            if key not in self.params:
                near = ", ".join(name for name in self.params.keys() if "." in name)
                raise InputError(f"{key}: no parameter of the scene; there are: {near}")
            _, _, node, flags = self.params.properties[key]
            constant = mi.ParamFlags.NonDifferentiable | mi.ParamFlags.Discontinuous
            if isinstance(node, mi.Sensor | mi.Film | mi.Sampler) or flags & constant:
                raise InputError(
                    f"{key}: a constant of the derivative, as lens, film and the shape "
                    "of surfaces are; leave it out of params (mi.render differentiates "
                    "by the lens, prb_projective by shapes)"
                )
        self.keys: tuple[str, ...] = tuple(keys)

    def __repr__(self) -> str:
        """Name integrator, size and parameters."""
        kind, (width, height) = type(self.integrator).__name__, self.camera.size
        return f"SceneSensor({kind}, {width}x{height}, params={list(self.keys)})"

    def observe(self, state: Any, step: int) -> Observation:
        """Render a frame; see :meth:`AbstractSensor.observe`."""
        self.renders += dr.width(state)
        with dr.suspend_grad():
            sampler, ray, weight = self.camera.rays(_pose(state), dr.width(state), step)
            colour, _, _, kept = self._sample(dr.ADMode.Primal, sampler, ray)
            linear = self.camera.pixels(colour * weight)
            dr.eval(linear, kept)
        return self._observation(linear, kept, dr.width(state), step)

    def keep(self, observation: Observation) -> Any:
        """Keep the pixels, and what the integrator hands to its derivatives."""
        return observation.linear, observation.kept

    def restore(self, state: Any, step: int, kept: Any) -> Observation:
        """See :meth:`AbstractDifferentiableSensor.restore`."""
        linear, inner = kept
        return self._observation(linear, inner, dr.width(state), step)

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`.

        Raises:
            InputError: `attached`, and the integrator has no derivative by its rays.
        """
        count = dr.width(state)
        if attached:
            self._check_attached()
        # From the developed image back to the radiance of each sample
        d_linear = vjp(_develop, observation.linear, _colours(d_image))
        leaf = _pose(state)
        if attached:
            dr.enable_grad(leaf)
        with dr.suspend_grad(when=not attached):
            sampler, ray, weight = self.camera.rays(leaf, count, observation.step)
        with dr.suspend_grad():
            δL = self.camera.spread(d_linear) * dr.detach(weight)
            # From the radiance to the parameters and, through its rays, to the state
            with dr.isolate_grad():
                self._sample(dr.ADMode.Backward, sampler, ray, δL, observation.kept)
        if not attached:
            return None
        result = dr.grad(leaf)
        dr.eval(result)
        return result

    def _sample(
        self,
        mode: dr.ADMode,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        δL: Any = None,
        state_in: Any = None,
    ) -> tuple[Any, ...]:
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
            width=self.camera.size[0] * self.camera.spp,
        )

    def _observation(
        self, linear: mi.Color3f, kept: Any, count: int, step: int
    ) -> Observation:
        width, height = self.camera.size
        with dr.suspend_grad():
            pixels = dr.ravel(_develop(linear))
            dr.eval(pixels)
        image = mi.TensorXf(pixels, (count, height, width, 3))
        return Observation(image, step=step, linear=linear, kept=kept)

    # Parameters

    def parameters(self) -> dict[str, Any]:
        """Return the values of the parameters that are differentiated, by key."""
        return {key: self.params[key] for key in self.keys}

    def set_parameters(self, values: Mapping[str, Any]) -> None:
        """Replace parameters by detached values.

        Args:
            values: by key of `mi.traverse(scene)`. A value that the scene has already
                is left as it is, with its derivatives.

        Raises:
            InputError: there is no such parameter, or its value is not allowed.
        """
        for key, value in values.items():
            if key not in self.params:
                raise InputError(f"{key}: no parameter of the scene")
            if not _is_same(self.params[key], value):
                self.params[key] = dr.detach(value) if _is_array(value) else value
        self.params.update()

    def start_gradient(self, poses: bool = False) -> None:
        """Let the gradients of all parameters be zero.

        Args:
            poses: collect those of :meth:`offsets`, too.

        Raises:
            InputError: a parameter has no derivative; the message names what works.
        """
        self.stop_gradient()
        moved = [f"{name}.to_world" for name in self._objects()] if poses else []
        try:
            self._start(list(dict.fromkeys([*self.keys, *moved])))
        except BaseException:
            self.stop_gradient()
            raise

    def _start(self, keys: list[str]) -> None:
        if self._collector is not None:
            self._collector.start_gradient(self.scene, keys)
        for key in keys:
            if self._packed(key) is None:
                value = self.params[key]
                self._before[key] = type(value)(value)
                leaf = type(value)(dr.detach(value))
                dr.enable_grad(leaf)
                self.params[key] = self._leaves[key] = leaf
        if self._leaves:  # an update evaluates the values of all parameters
            self.params.update()
        self._arrays = [(field, start_gradient(field)) for field in self._fields()]

    def gradients(self) -> dict[str, Any]:
        """Return what has been accumulated, by key, each of its parameter's shape."""
        if self._collector is not None:
            self._collector.finish_gradient()
        found = {}
        for key in self.keys:
            field = self._packed(key)
            name = key.rpartition(".")[2]
            leaf = self._leaves.get(key)
            found[key] = dr.grad(leaf) if field is None else gradient(field, name)
        dr.eval(found)
        return found

    def stop_gradient(self) -> None:
        """See :meth:`AbstractDifferentiableSensor.stop_gradient`."""
        if self._collector is not None:
            self._collector.stop_gradient()
        for key, value in self._before.items():
            self.params[key] = value
        if self._before:
            self.params.update()
        for field, packed in self._arrays:
            field.packed = packed
        self._before, self._leaves, self._arrays = {}, {}, []

    def _packed(self, key: str) -> GridField | None:
        """Return the grid field whose packed array a parameter is part of."""
        node = self.params.properties[key][2]
        field = getattr(node, "field", None)
        is_part = key.rpartition(".")[2] in ("colour", "density")
        return field if is_part and isinstance(field, GridField) else None

    def _fields(self) -> list[GridField]:
        found = {id(field): field for key in self.keys if (field := self._packed(key))}
        return list(found.values())

    # Objects: grid fields with colours among the parameters

    def _objects(self) -> dict[str, Any]:
        """Return the volumes by the prefix of their keys."""
        return {
            key.rpartition(".")[0]: self.params.properties[key][2]
            for key in self.keys
            if key.endswith(".colour") and self._packed(key) is not None
        }

    @property
    def fields(self) -> list[GridField]:
        """See :meth:`AbstractDifferentiableSensor.fields`."""
        return [volume.field for volume in self._objects().values()]

    @property
    def objects(self) -> list[PosedField]:
        """The objects where they are, as environments show them."""
        return [volume.posed for volume in self._objects().values()]

    @property
    def intrinsics(self) -> Camera:
        """The lens of the scene's sensor, for other environments."""
        return from_mitsuba(self.camera.sensor)[0]

    def textures(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.textures`."""
        return [field.texture for field in self.fields]

    def set_textures(self, textures: list[Any]) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_textures`."""
        for field, texture in zip(self.fields, textures, strict=True):
            field.set_parameter("texture", texture)

    def texture_gradients(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.texture_gradients`."""
        if self._collector is not None:
            self._collector.finish_gradient()
        return [gradient(field, "texture") for field in self.fields]

    def offsets(self) -> np.ndarray:
        """See :meth:`AbstractDifferentiableSensor.offsets`."""
        volumes = self._objects().values()
        return np.array([volume.posed.offset for volume in volumes]).reshape(-1, 6)

    def set_offsets(self, offsets: np.ndarray) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_offsets`."""
        volumes = list(self._objects().values())
        offsets = np.asarray(offsets, np.float64)
        if offsets.shape != (len(volumes), 6) or not np.isfinite(offsets).all():
            raise ValueError(
                f"offsets: shape {offsets.shape}; expected finite ({len(volumes)}, 6)"
            )
        for volume, offset in zip(volumes, offsets, strict=True):
            volume.posed.move(*offset_pose(volume.posed.pose, offset))
            volume.posed.offset = offset.copy()

    def offset_gradients(self) -> np.ndarray:
        """See :meth:`AbstractDifferentiableSensor.offset_gradients`."""
        found = []
        for name, volume in self._objects().items():
            leaf = self._leaves[f"{name}.to_world"]
            matrix, slope = (
                np.array(x, np.float64).reshape(4, 4)[:3]
                for x in (dr.detach(leaf.matrix), dr.grad(leaf.matrix))
            )
            torque = np.cross(matrix[:, :3].T, slope[:, :3].T).sum(0)
            wrench = -np.concatenate([slope[:, 3], torque])
            found.append(offset_gradient(wrench, volume.posed.offset))
        return np.array(found).reshape(-1, 6)

    def _check_attached(self) -> None:
        if self._collector is None:
            raise InputError(
                f"attached: {type(self.integrator).__name__} has no derivative by the "
                "camera; set attached to false, or show fields by a field_integrator"
            )


def _is_array(value: Any) -> bool:
    return bool(dr.detail.collect_indices(value))


def _is_same(a: Any, b: Any) -> bool:
    """Tell whether two values are one and the same in memory, or equal numbers."""
    if not _is_array(a) or not _is_array(b):
        return bool(np.all(np.equal(a, b)))
    one, other = (dr.detail.collect_indices(dr.detach(value)) for value in (a, b))
    return one == other


def _develop(linear: mi.Color3f) -> mi.Color3f:
    return dr.linear_to_srgb(linear)


def _pose(state: Any) -> Any:
    """Return the rows px, py, theta of a state, (3, n), detached."""
    kind = dr.float64_array_t(mi.Vector3f)
    return kind(*[dr.detach(state[i]) for i in range(3)])


def _colours(image: Any) -> mi.Color3f:
    """Return the pixels of an image (n, height, width, 3) as (3, n height width)."""
    index = dr.arange(mi.UInt32, dr.width(image.array) // 3)
    return dr.gather(mi.Color3f, image.array, index)
