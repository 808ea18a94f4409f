"""Any Mitsuba scene as what policies see: the integrator is the renderer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.arrays import differentiates_rays, vjp
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.fields.vertex_colours import gradient
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera.conventions import from_mitsuba
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.lighting.shading import light_maps
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain
from mi_nerfattack.rollout.camera import SceneCamera
from mi_nerfattack.rollout.parameters import CollectsRays, Differentiated
from mi_nerfattack.rollout.sensor import (
    AbstractDifferentiableSensor,
    AbstractSensor,
    Observation,
)
from mi_nerfattack.rollout.variation import Variation


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
        sensor: index of the scene's sensor, or another one.
        seed: of all random numbers, renewed each control period.
        integrator: in the place of the scene's own, as of `mi.render`; its parameters
            are not among those of the scene.
        centred: let rays go through the middles of n x n squares of a pixel, not
            through random places in it; the sensor's samples per pixel are n^2.

    Raises:
        InputError: no such key or sensor, samples that are no square of a number, or
            an integrator without that protocol.
        SetupError: the variant has other colours than red, green and blue.
    """

    def __init__(
        self,
        scene: mi.Scene,
        mount: CameraMount | None = None,
        params: Sequence[str] = (),
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        integrator: Any = None,
        centred: bool = False,
    ) -> None:
        if not mi.is_rgb:
            raise SetupError(
                f"variant {mi.variant()!r}: a policy's camera has three colours; set "
                "MI_NERFATTACK_VARIANT=llvm_ad_rgb, or call "
                "mitsuba.set_variant('llvm_ad_rgb')"
            )
        self.scene = scene
        self.integrator: Any = integrator or scene.integrator()
        if not differentiates_rays(self.integrator):
            raise InputError(
                f"scene: its integrator {self.integrator.class_name()} cannot be "
                "differentiated ray by ray; use field_integrator or prb"
            )
        if isinstance(sensor, int):
            sensor = _sensor_of(scene, sensor)
        self.camera: SceneCamera = SceneCamera(
            sensor, mount or CameraMount(), seed, centred
        )
        #: A `field_integrator`, which marches rays of several frames together.
        self._collector: CollectsRays | None = None
        if isinstance(self.integrator, CollectsRays):
            self._collector = self.integrator
        self._parameters = Differentiated(scene, self._collector)
        self.select(params)
        self._lit: dict[int, PosedField] = {}  # by `id`, those whose light varies
        self._counter = [0]  # shared by copies

    def __repr__(self) -> str:
        kind, (width, height) = type(self.integrator).__name__, self.camera.size
        return f"SceneSensor({kind}, {width}x{height}, params={list(self.keys)})"

    def observe(self, state: Any, step: int) -> Observation:
        """Render a frame; see :meth:`AbstractSensor.observe`."""
        count = dr.width(state)
        self._counter[0] += count
        # From the state to rays, to their radiance, and to linear pixels
        with dr.suspend_grad():
            sampler, *view = self.camera.rays(pose_of(state), count, step)
            linear, kept = self._render(sampler, view, None)
        return self._observation(linear, kept, view, count, step)

    @property
    def renders(self) -> int:
        """Images so far, those of copies with other draws too."""
        return self._counter[0]

    def numbered(self, first: int) -> SceneSensor:
        """See :meth:`AbstractSensor.numbered`; the scene is shared."""
        return self._drawing(first, self.camera.variation)

    def varied(self, variation: Variation) -> SceneSensor:
        """Return this sensor with another light and mount in each drive of a batch.

        The light varies on the :attr:`objects` that there are now. Where it has a sun,
        objects that have no `LightMaps` get those of :func:`light_maps`.

        Raises:
            InputError: light on objects, and there are none.
        """
        objects = {id(posed): posed for posed in self.objects}
        if variation.of_light and not objects:
            raise InputError(
                "light: there are no objects whose light could vary; show grid fields "
                "by a field_integrator, and select their colours"
            )
        for posed in objects.values() if variation.sun is not None else ():
            posed.light_maps = posed.light_maps or light_maps(posed.field)
        result = self._drawing(self.camera.first, variation)
        result._lit = objects if variation.of_light else {}
        return result

    def drawing_as(self, other: AbstractSensor) -> SceneSensor:
        """See :meth:`AbstractSensor.drawing_as`."""
        if not isinstance(other, SceneSensor):
            return self
        camera = other.camera
        result = self if camera.variation is None else self.varied(camera.variation)
        return result.numbered(camera.first)

    def _drawing(self, first: int, variation: Variation | None) -> SceneSensor:
        result = copy(self)
        result.camera = self.camera.changed(first, variation)
        return result

    def keep(self, observation: Observation) -> Any:
        """Keep what the integrator has to, or else the pixels and its whole state."""
        if self._collector is not None:
            return self._collector.keep(observation.kept)
        return observation.linear, observation.kept

    def restore(self, state: Any, step: int, kept: Any) -> Observation:
        """See :meth:`AbstractDifferentiableSensor.restore`."""
        count = dr.width(state)
        # The same rays again, whose fields are not marched again
        with dr.suspend_grad():
            sampler, *view = self.camera.rays(pose_of(state), count, step)
            if self._collector is None:
                linear, inner = kept
            else:
                dr.eval(view)
                inner = self._collector.restore(view[0], kept)
                linear, inner = self._render(sampler, view, inner)
        return self._observation(linear, inner, view, count, step)

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`.

        Raises:
            InputError: `attached`, and the integrator has no derivative by its rays.
        """
        # From the developed image back to the radiance of each sample
        d_linear = vjp(_develop, observation.linear, _colours(d_image))
        leaf, view = None, observation.view
        count, step = dr.width(state), observation.step
        if attached:
            self.check_attached()
            leaf = pose_of(state)
            dr.enable_grad(leaf)
            _, *view = self.camera.rays(leaf, count, step)
        with dr.suspend_grad():
            ray, weight = view
            δL = self.camera.spread(d_linear) * dr.detach(weight)
            # From the radiance to the parameters and, through its rays, to the state
            with dr.isolate_grad():
                sampler, kept = self.camera.sampler(count, step), observation.kept
                self._sample(dr.ADMode.Backward, sampler, ray, δL, kept)
        if leaf is None:
            return None
        result = dr.grad(leaf)
        dr.eval(result)
        return result

    def _render(
        self, sampler: mi.Sampler, view: Any, state_in: Any
    ) -> tuple[mi.Color3f, Any]:
        """Return linear pixels, and the integrator's state."""
        ray, weight = view
        mode = dr.ADMode.Primal
        gains = [] if state_in is not None else self._gains(dr.width(ray.o))
        colour, _, _, kept = self._sample(mode, sampler, ray, None, state_in, gains)
        linear = self.camera.pixels(colour * weight)
        dr.eval(linear, kept)
        return linear, kept

    def _sample(
        self,
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
            width=self.camera.size[0] * self.camera.spp,
            **lit,
        )

    def _gains(self, rays: int) -> list[Gain]:
        """Return the variation's light on all layers; none for that of the capture."""
        if not self._lit:
            return []
        count, lit = rays // self.camera.per_image, self._lit
        found = {k: self.camera.gain(item, count) for k, item in lit.items()}
        return [found.get(id(layer), Gain()) for layer in self.layers]

    def _observation(
        self, linear: mi.Color3f, kept: Any, view: Any, count: int, step: int
    ) -> Observation:
        width, height = self.camera.size
        with dr.suspend_grad():
            pixels = dr.ravel(_develop(linear))
            dr.eval(pixels)
        image = mi.TensorXf(pixels, (count, height, width, 3))
        return Observation(image, step, linear, kept, view)

    # Parameters

    @property
    def params(self) -> Any:
        """All parameters of the scene, `mi.traverse(scene)`."""
        return self._parameters.params

    @property
    def keys(self) -> tuple[str, ...]:
        """See :meth:`AbstractDifferentiableSensor.keys`."""
        return self._parameters.keys

    def select(self, keys: Sequence[str]) -> None:
        """See :meth:`AbstractDifferentiableSensor.select`; keys of :attr:`params`."""
        self._parameters.select(keys)

    def parameters(self) -> dict[str, Any]:
        """Return the values of the parameters that are differentiated, by key."""
        return self._parameters.values()

    def set_parameters(self, values: Mapping[str, Any]) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_parameters`."""
        self._parameters.assign(values)

    def start_gradient(self, more: Sequence[str] = ()) -> None:
        """See :meth:`AbstractDifferentiableSensor.start_gradient`."""
        self._parameters.start(more)

    def gradients(self) -> dict[str, Any]:
        """See :meth:`AbstractDifferentiableSensor.gradients`."""
        return self._parameters.gradients()

    def stop_gradient(self) -> None:
        """See :meth:`AbstractDifferentiableSensor.stop_gradient`."""
        self._parameters.stop()

    # Objects: grid fields with colours among the parameters

    @property
    def pose_keys(self) -> tuple[str, ...]:
        """See :meth:`AbstractDifferentiableSensor.pose_keys`."""
        return tuple(f"{name}.to_world" for name in self._parameters.objects())

    @property
    def objects(self) -> list[PosedField]:
        """See :meth:`AbstractDifferentiableSensor.objects`."""
        return [volume.posed for volume in self._parameters.objects().values()]

    @property
    def layers(self) -> list[Layer]:
        """All fields that a `field_integrator` shows, objects among them."""
        return list(getattr(self.integrator, "posed", []))

    @property
    def intrinsics(self) -> Camera:
        """The lens, for other environments.

        Raises:
            InputError: the sensor is no pinhole camera, or its film is cropped.
        """
        name = self.camera.sensor.id()
        if self.camera.sensor.needs_aperture_sample():
            raise InputError(f"sensor {name!r}: has an aperture; use perspective")
        found, _ = from_mitsuba(self.camera.sensor)
        if self.camera.size != (found.width, found.height):
            raise InputError(
                f"sensor {name!r}: its film has a crop window; remove crop_* from it"
            )
        return found

    @property
    def mount(self) -> CameraMount:
        """Pose of the camera on the vehicle."""
        return self.camera.mount

    def textures(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.textures`."""
        return [field.texture for field in self.fields]

    def set_textures(self, textures: list[Any]) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_textures`."""
        for field, texture in zip(self.fields, textures, strict=True):
            field.set_parameter("texture", texture)

    def texture_gradients(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.texture_gradients`."""
        self._parameters.finish()
        return [gradient(field, "texture") for field in self.fields]

    def check_attached(self) -> None:
        """Raise InputError where images have no derivative by the state."""
        if self._collector is None:
            raise InputError(
                f"attached: {type(self.integrator).__name__} has no derivative by the "
                "camera; set attached to false, or show fields by a field_integrator"
            )
        self._collector.check_camera(self.scene)


def _sensor_of(scene: mi.Scene, index: int) -> mi.Sensor:
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise InputError(f"sensor: {index}; the scene has {count}, from 0 on")
    return scene.sensors()[index]


def _develop(linear: mi.Color3f) -> mi.Color3f:
    return dr.linear_to_srgb(linear)


def pose_of(state: Any) -> Any:
    """Return the rows px, py, theta of a state, (3, n), detached."""
    kind = dr.float64_array_t(mi.Vector3f)
    return kind(*[dr.detach(state[i]) for i in range(3)])


def _colours(image: Any) -> mi.Color3f:
    """Return the pixels of an image (n, height, width, 3) as (3, n height width)."""
    index = dr.arange(mi.UInt32, dr.width(image.array) // 3)
    return dr.gather(mi.Color3f, image.array, index)
