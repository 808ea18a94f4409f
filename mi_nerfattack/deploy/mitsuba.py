"""The path-traced scene as a deployment environment, objects pasted by depth."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.views import ViewRenderer
from mi_nerfattack.colour import linear_to_srgb_numpy
from mi_nerfattack.render.camera import (
    Camera,
    CameraMount,
    generate_rays,
    mount_matrix,
    pose_arrays,
)
from mi_nerfattack.render.composite import DepthComposite
from mi_nerfattack.render.march import STOP, March, Rays
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.sensor import AbstractSensor, Observation

OPAQUE = 0.5


def paste(
    rgb: np.ndarray, depth: np.ndarray, layer: March, threshold: float = OPAQUE
) -> np.ndarray:
    """Paste a field into an image as if it were opaque.

    Where the field's opacity reaches the threshold and its expected depth is nearer
    than the scene, the pixel takes the field's colour ``I / a``; elsewhere it stays.

    Args:
        rgb: (height, width, 3), linear.
        depth: (height, width), metres along the ray; infinite where there is nothing.
        layer: march of height * width rays, row by row from the top left.
        threshold: of the opacity.

    Returns:
        (height, width, 3), linear.

    Source: appendix B.3.
    """
    shape = depth.shape
    opacity = layer.opacity.numpy().reshape(shape)
    nearer = layer.depth.numpy().reshape(shape) < depth
    mask = (opacity >= threshold) & nearer
    radiance = layer.radiance.numpy().T.reshape(*shape, 3)
    colour = radiance / np.where(mask, opacity, 1)[..., None]
    return np.where(mask[..., None], colour, rgb).astype(np.float32)


class PathTracedSensor(AbstractSensor):
    """Camera on a vehicle in a stock Mitsuba scene.

    Every image has samples of its own, seeded by seed, step and vehicle.

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
        self.renderer = ViewRenderer(scene, camera)
        self.objects = list(objects)
        self.camera = camera
        self.mount = mount or CameraMount()
        self.spp = spp
        self.seed = seed
        self.renders = 0

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
        view = self.renderer.render(camera_to_world, self.spp, seed)
        if not self.objects:
            return view.rgb
        return paste(view.rgb, view.depth, self.object_layer(camera_to_world))

    def layers(self, camera_to_world: np.ndarray, step: int) -> dict[str, np.ndarray]:
        """Render one frame with its parts.

        Returns:
            by layer name: the pasted frame as ``""`` (height, width, 4) and ``Z``,
            the scene alone as ``scene`` and ``scene.Z``, the objects as ``object``
            (premultiplied) and ``object.Z``; linear, metres.
        """
        view = self.renderer.render(camera_to_world, self.spp, self._seeds(step, 1)[0])
        one = np.ones((*view.depth.shape, 1), np.float32)
        scene = np.concatenate([view.rgb, one], axis=-1)
        if not self.objects:
            return {"": scene, "Z": view.depth}
        layer = self.object_layer(camera_to_world)
        opacity = layer.opacity.numpy().reshape(*view.depth.shape, 1)
        depth = layer.depth.numpy().reshape(view.depth.shape)
        radiance = layer.radiance.numpy().T.reshape(*view.depth.shape, 3)
        pasted = paste(view.rgb, view.depth, layer)
        in_front = (opacity[..., 0] >= OPAQUE) & (depth < view.depth)
        return {
            "": np.concatenate([pasted, one], axis=-1),
            "Z": np.where(in_front, depth, view.depth),
            "scene": scene,
            "scene.Z": view.depth,
            "object": np.concatenate([radiance, opacity], axis=-1),
            "object.Z": depth,
        }

    def _seeds(self, step: int, count: int) -> list[int]:
        sequence = np.random.SeedSequence([self.seed, step])
        return [int(seed) for seed in sequence.generate_state(count)]

    def object_layer(self, camera_to_world: np.ndarray) -> March:
        """March all objects along the rays of one image."""
        origin, rotation = pose_arrays(camera_to_world)
        o, d = generate_rays(self.camera, origin, rotation, 1)
        jitter, far = dr.opaque(mi.Float, 0.5), dr.opaque(mi.Float, dr.inf)
        rays = Rays(o, d, far, jitter, mi.Bool(True))
        result = DepthComposite().render(self.objects, rays, STOP).total
        dr.eval(result)
        return result
