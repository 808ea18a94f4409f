"""Any Mitsuba scene as what policies see: the integrator is the renderer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.fields.vertex_colours import gradient
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera.disturbance import side_by_side
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.camera.rig import ONLY, Layout, Rig
from mi_nerfattack.render.lighting.shading import light_maps
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain
from mi_nerfattack.rollout.camera import SceneCamera, sensor_of
from mi_nerfattack.rollout.images import SceneImages
from mi_nerfattack.rollout.parameters import Differentiated
from mi_nerfattack.rollout.sensor import (
    AbstractDifferentiableSensor,
    AbstractSensor,
    Observation,
)
from mi_nerfattack.rollout.variation import Variation


class SceneSensor(AbstractDifferentiableSensor):
    """Cameras on a vehicle that see a Mitsuba scene as its integrator renders it.

    An image is that of `mi.render` with the scene's sensor on the vehicle, developed
    by a box filter: lens, clip distances, film size and samples per pixel are the
    sensor's, its pose is not. The derivative is the integrator's own ``sample`` in
    backward mode, with the random numbers of the forward pass. So the integrator needs
    the protocol of Mitsuba's `RBIntegrator`, as `field_integrator`, `prb`, `prbvolpath`
    and `volprim_rf_basic` have it. Lens and film are constants of the derivative, and
    so is the shape of surfaces, since visibility has no derivative here.

    A sensor has one camera, until :meth:`with_rig` adds others: then the images of all
    lie side by side in a frame.

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
        self._images = SceneImages(scene, self.integrator)
        if isinstance(sensor, int):
            sensor = sensor_of(scene, sensor)
        camera = SceneCamera(sensor, mount or CameraMount(), seed, centred=centred)
        self.cameras: tuple[SceneCamera, ...] = (camera,)
        self.names: tuple[str, ...] = (ONLY,)
        self._parameters = Differentiated(scene, self._images.collector)
        self.select(params)
        self._lit: dict[int, PosedField] = {}  # by `id`, those whose light varies
        self._counter = [0]  # shared by copies

    def __repr__(self) -> str:
        kind, (width, height) = type(self.integrator).__name__, self._layout.size
        return f"SceneSensor({kind}, {width}x{height}, params={list(self.keys)})"

    def observe(self, state: Any, step: int) -> Observation:
        """Render a frame; see :meth:`AbstractSensor.observe`."""
        self._counter[0] += dr.width(state)
        observations = [
            self._images.observe(each, state, step, self._gains(each, state))
            for each in self.cameras
        ]
        return self._join(observations)

    def _join(self, observations: list[Observation]) -> Observation:
        if len(observations) == 1:
            return observations[0]
        image = side_by_side([each.image for each in observations], self._layout)
        dr.eval(image)
        return Observation(image, observations[0].step, per_camera=tuple(observations))

    @property
    def renders(self) -> int:
        """Images so far, those of copies with other draws too."""
        return self._counter[0]

    def numbered(self, first: int) -> SceneSensor:
        """See :meth:`AbstractSensor.numbered`; the scene is shared."""
        return self._drawing(first=first)

    def varied(self, variation: Variation) -> SceneSensor:
        """Return this sensor with another light and mount in each drive of a batch.

        All cameras of a vehicle are raised and pitched alike. The light varies on the
        :attr:`objects` that there are now. Where it has a sun, objects that have no
        `LightMaps` get some, made of their field.

        Raises:
            InputError: light on objects, and a `field_integrator` shows none.
        """
        objects = {id(posed): posed for posed in self.objects}
        layers = {id(layer) for layer in self.layers}
        if variation.of_light and not (objects and objects.keys() <= layers):
            raise InputError(
                "light: there are no objects whose light could vary; show grid fields "
                "by a field_integrator, and select their colours"
            )
        for posed in objects.values() if variation.sun is not None else ():
            posed.light_maps = posed.light_maps or light_maps(posed.field)
        result = self._drawing(variation=variation)
        result._lit = objects if variation.of_light else {}
        return result

    def drawing_as(self, other: AbstractSensor) -> SceneSensor:
        """See :meth:`AbstractSensor.drawing_as`."""
        if not isinstance(other, SceneSensor):
            return self
        camera = other.camera
        result = self if camera.variation is None else self.varied(camera.variation)
        return result.numbered(camera.first)

    def _drawing(self, **changes: Any) -> SceneSensor:
        cameras = [camera.changed(**changes) for camera in self.cameras]
        return self._with(self.names, cameras)

    def _with(
        self, names: Sequence[str], cameras: Sequence[SceneCamera]
    ) -> SceneSensor:
        result = copy(self)
        result.names, result.cameras = tuple(names), tuple(cameras)
        return result

    def keep(self, observation: Observation) -> Any:
        """Keep what the integrator has to of each camera's image."""
        return [
            self._images.keep(each) for each in observation.per_camera or [observation]
        ]

    def restore(self, state: Any, step: int, record: Any) -> Observation:
        """See :meth:`AbstractDifferentiableSensor.restore`."""
        observations = [
            self._images.restore(camera, state, step, one, self._gains(camera, state))
            for camera, one in zip(self.cameras, record, strict=True)
        ]
        return self._join(observations)

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`.

        Raises:
            InputError: `attached`, and the integrator has no derivative by its rays.
        """
        # Each camera adds to the gradients of the parameters, and to the state's
        observations, by_pose = observation.per_camera or [observation], None
        d_parts = self._layout.split(d_image)
        for item in zip(self.cameras, observations, d_parts, strict=True):
            camera, part, d_part = item
            by_one = self._images.vjp(camera, part, state, d_part, attached)
            by_pose = by_one if by_pose is None else by_pose + by_one
        dr.eval(by_pose)
        return by_pose

    def _gains(self, camera: SceneCamera, state: Any) -> list[Gain]:
        """Return the variation's light on all layers; none for that of the capture."""
        if not self._lit:
            return []
        count, lit = dr.width(state), self._lit
        gains = {k: camera.gain(item, count) for k, item in lit.items()}
        return [gains.get(id(layer), Gain()) for layer in self.layers]

    # Cameras

    @property
    def camera(self) -> SceneCamera:
        """The first camera."""
        return self.cameras[0]

    @property
    def intrinsics(self) -> Camera:
        """The first camera's lens, for other environments.

        Raises:
            InputError: the sensor is no pinhole camera, or its film is cropped.
        """
        return self.camera.intrinsics

    @property
    def mount(self) -> CameraMount:
        """Pose of the first camera on the vehicle."""
        return self.camera.mount

    @property
    def rig(self) -> Rig:
        """All cameras; InputError as of :attr:`intrinsics`."""
        lenses = tuple(camera.intrinsics for camera in self.cameras)
        return Rig(self.names, lenses, tuple(camera.mount for camera in self.cameras))

    def with_rig(self, rig: Rig) -> SceneSensor:
        """Return this sensor with all cameras of a vehicle.

        The first one is this sensor's, whose lens stays as it is. The others have its
        clip distances and samples per pixel, and random numbers of their own.

        Args:
            rig: names, mounts, and the lenses of all cameras but the first.
        """
        cameras = [self.camera.changed(mount=rig.mounts[0])]
        pairs = zip(rig.cameras[1:], rig.mounts[1:], strict=True)
        for index, (lens, mount) in enumerate(pairs, start=1):
            cameras.append(self.camera.another(lens, mount, index))
        return self._with(rig.names, cameras)

    def seeing_as(
        self, other: SceneSensor, mounts: Sequence[CameraMount] = ()
    ) -> SceneSensor:
        """Return this sensor with the cameras of another one, and all their draws.

        Args:
            other: sees another scene, or other objects.
            mounts: poses of the cameras on the vehicle, if others.
        """
        cameras = other.cameras
        if mounts:
            pairs = zip(cameras, mounts, strict=True)
            cameras = [camera.changed(mount=mount) for camera, mount in pairs]
        return self._with(other.names, cameras).drawing_as(other)

    def through(self, index: int) -> SceneSensor:
        """Return this sensor with one of its cameras alone."""
        result = self._with(self.names[index : index + 1], [self.cameras[index]])
        if index:
            result._counter = [0]  # frames are counted by their first image
        return result

    @property
    def layout(self) -> Layout | None:
        """See :attr:`AbstractSensor.layout`."""
        return self._layout if len(self.cameras) > 1 else None

    @property
    def _layout(self) -> Layout:
        return Layout(tuple(camera.size for camera in self.cameras))

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

    def set_parameters(self, values: Mapping[str, Any]) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_parameters`."""
        self._parameters.assign(values)

    def start_gradient(self, extra_keys: Sequence[str] = ()) -> None:
        """See :meth:`AbstractDifferentiableSensor.start_gradient`."""
        self._parameters.start(extra_keys)

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
        self._images.check_attached()
