"""The path-traced scene as a sensor of closed loops, objects pasted by depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.deploy.views.mitsuba import MitsubaView
from mi_nerfattack.deploy.views.paste import paste_layers
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.sensor import AbstractSensor, Observation


class PathTracedSensor(AbstractSensor):
    """Camera on a vehicle in a stock Mitsuba scene.

    Every image has samples of its own, seeded by seed, step and vehicle. The images
    are those of `MitsubaView`, linear where it rounds to eight bits.

    Args:
        scene: any Mitsuba scene, metric, z up; its own integrator renders it.
        objects: fields that are pasted by depth at opacity 1; may be empty.
        camera: intrinsics.
        mount: pose on the vehicle.
        spp: samples per pixel.
        seed: of the samples.
    """

    def __init__(
        self,
        scene: mi.Scene,
        objects: list[PosedField],
        camera: Camera,
        mount: CameraMount | None = None,
        spp: int = 16,
        seed: int = 0,
    ) -> None:
        self.view = MitsubaView(scene, camera, spp)
        self.objects = objects
        self.camera = camera
        self.mount = mount or CameraMount()
        self.seed = seed
        self.renders = 0

    @property
    def objects(self) -> list[PosedField]:
        """The fields that are pasted; assign to show others."""
        return list(self._objects)

    @objects.setter
    def objects(self, objects: list[PosedField]) -> None:
        self._objects = list(objects)
        self.view.show(self._objects)

    def observe(self, state: Any, step: int) -> Observation:
        """Render one image a vehicle; see :meth:`AbstractSensor.observe`."""
        poses = mount_matrix(np.array(state).T[:, :3], self.mount)
        images = [
            linear_to_srgb_numpy(self.linear(pose, seed))
            for pose, seed in zip(poses, self._seeds(step, len(poses)), strict=True)
        ]
        self.renders += len(images)
        image = mi.TensorXf(np.stack(images).astype(np.float32))
        dr.eval(image)
        return Observation(image)

    def linear(self, camera_to_world: np.ndarray, seed: int) -> np.ndarray:
        """Render one image with its objects, (height, width, 3), linear."""
        rgb, depth = self.view.linear(camera_to_world, seed)
        return paste_layers(rgb, depth, self.view.march(camera_to_world))[0]

    def layers(
        self, camera_to_world: np.ndarray, step: int, names: Sequence[str]
    ) -> dict[str, np.ndarray]:
        """Render one frame with its parts.

        Args:
            camera_to_world: (4, 4), OpenCV axes, metres.
            step: seeds the samples.
            names: of the objects' layers.

        Returns:
            by layer name: the pasted frame as ``""`` (height, width, 4) and ``Z``,
            the scene alone as ``scene`` and ``scene.Z``, each object by its name
            (premultiplied), ``NAME`` and ``NAME.Z``; linear, metres.
        """
        rgb, far = self.view.linear(camera_to_world, self._seeds(step, 1)[0])
        objects = self.view.march(camera_to_world)
        pasted, depth = paste_layers(rgb, far, objects)
        one = np.ones((*far.shape, 1), np.float32)
        layers = {
            "": np.concatenate([pasted, one], axis=-1),
            "Z": depth,
            "scene": np.concatenate([rgb, one], axis=-1),
            "scene.Z": far,
        }
        for name, layer in zip(names, objects, strict=True):
            layers |= layer.images(name, far.shape)
        return layers

    def _seeds(self, step: int, count: int) -> list[int]:
        sequence = np.random.SeedSequence([self.seed, step])
        return [int(seed) for seed in sequence.generate_state(count)]
