"""Paste radiance fields into images by depth, as if they were opaque (appendix B.3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.views.above import PixelRays
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.march import STOP, march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

#: Opacity from which on a field's pixel counts as solid.
OPAQUE = 0.5
#: Largest coordinate of a camera, metres, where 32 bits are 8 mm apart.
FARTHEST_M = 1e5


class Paster:
    """Pastes objects into the frames of one camera.

    Objects are pasted one by one: where an object's opacity reaches 0.5 and its
    expected depth is nearer than all that is there, a pixel takes its colour ``I / a``
    and its depth; elsewhere it stays. So what lies between two objects hides the
    farther, edges of the nearer included. The colour is the field's own: neither the
    light nor the exposure of the frame changes it. After the first frame no kernel is
    compiled. Poses and textures of the objects may change between frames; for other
    objects make another.

    Args:
        camera: intrinsics of the frames.
        objects: may be none.

    Source: appendix B.3.
    """

    def __init__(self, camera: Camera, objects: Sequence[PosedField]) -> None:
        require_fields(objects)
        self.camera, self.objects = camera, list(objects)
        self._rays = PixelRays(camera)
        self._frozen = freeze_method(self._record, self._state)

    def march(self, camera_to_world: np.ndarray) -> list[March]:
        """March each object by itself along the rays of one image.

        Raises:
            InputError: the camera is so far away that single precision cannot tell
                where an object ends.
        """
        position = np.asarray(camera_to_world)[:3, 3]
        if not np.abs(position).max() <= FARTHEST_M:
            raise InputError(
                f"camera at {position.round(1).tolist()} m: objects are pasted in "
                f"single precision, within {FARTHEST_M:g} m of the origin; put the "
                "origin of poses and objects near the drive"
            )
        if not self.objects:
            return []
        with dr.suspend_grad():
            return self._frozen(self._rays.at(camera_to_world))

    def paste(self, frame: CameraFrame) -> CameraFrame:
        """Return the frame with the objects in it.

        Raises:
            InputError: the frame's size is not the camera's, or it is too far away.
        """
        size = (self.camera.height, self.camera.width)
        if frame.depth.shape != size or frame.image.shape != (*size, 3):
            raise InputError(
                f"frame: image {frame.image.shape}, depth {frame.depth.shape}; the "
                f"camera has {size[0]} x {size[1]} pixels"
            )
        if not self.objects:
            return frame
        pose = frame.camera_to_world
        layers = self.march(pose)
        linear, depth, owner = paste_layers(frame.light, frame.depth, layers)
        image, split = linear_to_uint8(linear), partial(_split, linear, depth, owner)
        return CameraFrame(image, depth, pose, linear=linear, split=split)

    def _record(self, rays: Rays) -> list[March]:
        return [march(posed, rays, STOP) for posed in self.objects]

    def _state(self, rays: Rays) -> list[Any]:
        states = [posed.state() for posed in self.objects]
        return [dr.width(rays.direction), states]


def require_fields(objects: Sequence[Any]) -> None:
    """Raise `InputError` unless all objects to show are posed fields."""
    for item in objects:
        if not isinstance(item, PosedField):
            raise InputError(
                f"objects: {type(item).__name__}; only posed fields can be shown"
            )


def paste_layers(
    linear: np.ndarray, depth: np.ndarray, layers: Sequence[March]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Paste marches into an image one by one, as if they were opaque.

    Args:
        linear: (height, width, 3), float32.
        depth: (height, width), metres along the ray; infinite where there is nothing.
        layers: marches of height * width rays, row by row from the top left.

    Returns:
        image and depth with the layers in them, and whose a pixel is, (height, width):
        0 for the image's own, k + 1 for that of layer k.

    Source: appendix B.3.
    """
    owner = np.zeros(depth.shape, int)
    for index, layer in enumerate(layers, start=1):
        opacity = layer.opacity.numpy().reshape(depth.shape)
        nearness = layer.depth.numpy().reshape(depth.shape)
        mask = (opacity >= OPAQUE) & (nearness < depth)
        radiance = layer.radiance.numpy().T.reshape(*depth.shape, 3)
        colour = radiance / np.where(mask, opacity, 1)[..., None]
        linear = np.where(mask[..., None], colour, linear)
        depth = np.where(mask, nearness, depth)
        owner[mask] = index
    return linear, depth, owner


def _split(
    linear: np.ndarray, depth: np.ndarray, owner: np.ndarray, objects: Sequence[str]
) -> dict[str, np.ndarray]:
    """Give each pixel to the layer whose it is; see :meth:`CameraFrame.layers`."""
    rgba = np.concatenate([linear, np.ones((*depth.shape, 1), np.float32)], axis=-1)
    layers = {}
    for index, name in enumerate(("scene", *objects)):
        own = owner == index
        layers[name] = np.where(own[..., None], rgba, np.float32(0))
        layers[f"{name}.Z"] = np.where(own, depth, np.inf)
    return layers


class AbstractView(ABC):
    """Camera in a static world, moved from image to image.

    Attributes:
        camera: intrinsics.
    """

    camera: Camera

    @abstractmethod
    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        """Render one frame.

        Args:
            camera_to_world: (4, 4), OpenCV axes, metres.
            seed: of the samples, in [0, 2^32).
        """

    def show(self, objects: Sequence[PosedField]) -> None:
        """Paste radiance fields instead of the former ones.

        Args:
            objects: may be empty.
        """
        self._paster = Paster(self.camera, objects)

    @abstractmethod
    def close(self) -> None:
        """Let go of what a window or a process holds."""
