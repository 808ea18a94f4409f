"""The surrogate as an environment: its sensor, one vehicle, frames taken apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.deploy.environment import CameraFrame, join_frames
from mi_nerfattack.deploy.simulated import AbstractSimulation
from mi_nerfattack.deploy.surrogate.scene import showing
from mi_nerfattack.deploy.vehicle import KinematicVehicle
from mi_nerfattack.deploy.views.paste import OPAQUE, require_fields
from mi_nerfattack.render.camera.intrinsics import mount_matrix
from mi_nerfattack.render.rays import March
from mi_nerfattack.render.scene_march import nearest_surface
from mi_nerfattack.rollout.camera import pose_of
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.rollout.sensor import Observation
from mi_nerfattack.vehicle.dynamics import to_state


@dataclass(frozen=True)
class Distances:
    """Where the rays of a frame begin and end, metres from the camera.

    Attributes:
        start: (n spp,), where they begin.
        far: (n,), the first surface in a pixel, infinite without one.
    """

    start: mi.Float
    far: mi.Float


@dataclass(frozen=True)
class Layers:
    """What reaches the camera, pixel by pixel; depths count from the camera.

    Attributes:
        others: share of each field that is no object.
        objects: share of each object of the sensor that is no emitter's.
        behind: of what is seen behind all fields; its moment is zero.
    """

    others: list[March]
    objects: list[March]
    behind: March


def measure(sensor: SceneSensor, observation: Observation, state: Any) -> Distances:
    """Measure the rays of a frame.

    Args:
        sensor: that observed.
        observation: what it observed.
        state: (m, n), where it did.
    """
    camera, (ray, _) = sensor.camera, observation.view
    with dr.suspend_grad():
        start = dr.norm(ray.o - camera.eye(pose_of(state), dr.width(state)))
        far = start + nearest_surface(sensor.scene, ray, mi.Bool(True))
        return Distances(start, camera.nearest(far))


def total_of(sensor: SceneSensor, observation: Observation, start: mi.Float) -> March:
    """Return what all fields show in a frame; depths count from the camera.

    Args:
        sensor: that observed.
        observation: what it observed.
        start: of :class:`Distances`.
    """
    marches = getattr(observation.integrator_state, "marches", None)
    if marches is None:  # no fields
        return March.zeros(dr.width(observation.linear))
    return _of_pixels(sensor.camera, marches.total, start)


def take_apart(
    sensor: SceneSensor, observation: Observation, start: mi.Float
) -> Layers:
    """Take a frame apart; arguments as of :func:`total_of`."""
    total, shares = total_of(sensor, observation, start), []
    if sensor.layers:
        marches = sensor.integrator.composite.shares(
            observation.integrator_state.marches
        )
        shares = [_of_pixels(sensor.camera, march, start) for march in marches]
    own = [id(posed) for posed in sensor.objects]
    ids = [id(layer) for layer in sensor.layers]
    behind = March(observation.linear - total.radiance, 1 - total.opacity)
    others = [march for k, march in zip(ids, shares, strict=True) if k not in own]
    return Layers(others, [shares[ids.index(k)] for k in own if k in ids], behind)


def _of_pixels(camera: Any, layer: March, start: mi.Float) -> March:
    """Average a layer over the samples of pixels, with depths from the camera."""
    moment = layer.moment + layer.opacity * start
    return March(
        camera.average(layer.radiance),
        camera.average(layer.opacity),
        camera.average(moment),
    )


class SurrogateEnvironment(AbstractSimulation):
    """The differentiable rollout of one vehicle: its sensor and its transition.

    Frames are the images of an attack in eight bits, which is what the policy gets in
    a `ClosedLoop`; the seed has no effect. The depth is the expected depth of all that
    a ray meets, infinite where it meets less than half an opacity.

    Args:
        sensor: sees, by one camera or several.
        vehicle: moves.
    """

    def __init__(self, sensor: SceneSensor, vehicle: KinematicVehicle) -> None:
        super().__init__("surrogate", vehicle, sensor.rig, vehicle.period)
        self.sensor = sensor

    def show(self, objects: Sequence[Any]) -> None:
        """Compose other fields with the scene's; grid fields, no two of one texture."""
        require_fields(objects)
        self.sensor = showing(self.sensor, list(objects))

    def close(self) -> None:
        """Nothing is held."""

    def _observe(self) -> CameraFrame:
        eyes = [self.sensor.through(k) for k in range(len(self.sensor.cameras))]
        return join_frames([self._frame(eye) for eye in eyes], self.rig.layout)

    def _frame(self, sensor: SceneSensor) -> CameraFrame:
        """Return the frame of one of the cameras."""
        state = to_state(self.state[None])
        observation = sensor.observe(state, self._steps)
        distances = measure(sensor, observation, state)
        total = total_of(sensor, observation, distances.start)
        depth = dr.select(total.opacity >= OPAQUE, total.depth, distances.far)
        shape = observation.image.shape[1:3]
        shown = [id(layer) for layer in sensor.layers]
        can_split = all(id(posed) in shown for posed in sensor.objects)
        return CameraFrame(
            np.round(255 * np.array(observation.image)[0]).astype(np.uint8),
            depth.numpy().reshape(shape),
            mount_matrix(self.state[None, :3], sensor.mount)[0],
            linear=observation.linear.numpy().T.reshape(*shape, 3),
            split=partial(_split, sensor, observation, distances, shape)
            if can_split
            else None,
        )


def _split(
    sensor: SceneSensor,
    observation: Observation,
    distances: Distances,
    shape: tuple[int, int],
    objects: Sequence[str],
) -> dict[str, np.ndarray]:
    """Take a frame apart; see :meth:`CameraFrame.layers`.

    Args:
        sensor: that observed.
        observation: what it observed.
        distances: of its rays.
        shape: height and width.
        objects: names.
    """
    layers = take_apart(sensor, observation, distances.start)
    names = [f"scene{k or ''}" for k in range(len(layers.others))]
    pairs = zip((*names, *objects), layers.others + layers.objects, strict=True)
    images = {}
    for name, layer in pairs:
        images |= layer.images(name, shape)
    images |= layers.behind.images("background", shape)
    far = dr.select(layers.behind.opacity > 0, distances.far, dr.inf)
    return images | {"background.Z": far.numpy().reshape(shape)}
