"""The surrogate simulator's camera: a scene's field with objects composed into it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.views.base import AbstractView
from mi_nerfattack.deploy.views.paste import OPAQUE, require_fields
from mi_nerfattack.deploy.views.rays import PixelRays
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.composite import AbstractComposite, DepthComposite
from mi_nerfattack.render.march import STOP
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays


class FieldView(AbstractView):
    """Camera at any pose in a scene's field: what `FieldSensor` shows, as frames.

    One ray a pixel through its centre, samples in the middle of their intervals, so
    that the seed has no effect. Behind everything is the background of the scene's
    field. The depth is the expected depth of all that a ray meets, infinite where it
    meets less than half an opacity. After the first frame no kernel is compiled.

    Cost: one march of the scene and one of each object a frame.

    Args:
        scene: the scene's field in the world, or a backdrop.
        camera: intrinsics.
        composite: how fields become one colour; `DepthComposite` by default.
        stop: transmittance at which rays end.
    """

    def __init__(
        self,
        scene: Layer,
        camera: Camera,
        composite: AbstractComposite | None = None,
        stop: float = STOP,
    ) -> None:
        self.scene, self.camera, self.stop = scene, camera, stop
        self.composite = composite or DepthComposite()
        self._rays = PixelRays(camera)
        self._ahead = self.composite.ahead(scene, stop)
        self.show(())

    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        """Render one frame; see :meth:`AbstractView.render`."""
        del seed
        shape = (self.camera.height, self.camera.width)
        with dr.suspend_grad():
            rays = self._rays.at(camera_to_world)
            kept = None if self._ahead is None else self._ahead.march(rays)
            linear, depth = self._picture.develop(rays, kept)
        image = linear_to_uint8(linear.numpy().T.reshape(*shape, 3))
        pose = np.array(camera_to_world, np.float64)
        return CameraFrame(image, depth.numpy().reshape(shape).copy(), pose)

    def show(self, objects: Sequence[PosedField]) -> None:
        """Compose other fields with the scene's."""
        require_fields(objects)
        layers = [self.scene, *objects]
        self.composite.check(layers)
        self._picture = _Picture(layers, self.composite, self.stop)

    def close(self) -> None:
        """Nothing is held."""


class _Picture:
    """Recorded launches that turn the rays of an image into its pixels.

    Args:
        layers: the scene, then objects.
        composite: how they become one colour.
        stop: transmittance at which rays end.
    """

    def __init__(
        self, layers: list[Layer], composite: AbstractComposite, stop: float
    ) -> None:
        self.layers, self.composite, self.stop = layers, composite, stop
        self._frozen_render = freeze_method(self._render, self._state)
        self._frozen_restore = freeze_method(self._restore, self._state)

    def develop(self, rays: Rays, kept: March | None) -> tuple[mi.Color3f, mi.Float]:
        """Return linear colours (3, n) and depths (n,) of n rays.

        Args:
            rays: n rays.
            kept: what the scene gave, if it was marched by itself.
        """
        if kept is None:
            return self._frozen_render(rays)
        return self._frozen_restore(rays, kept)

    def _render(self, rays: Rays) -> tuple[mi.Color3f, mi.Float]:
        seen = self.composite.render(self.layers, rays, self.stop)
        return self._finish(seen.total, rays)

    def _restore(self, rays: Rays, kept: March) -> tuple[mi.Color3f, mi.Float]:
        seen = self.composite.restore(self.layers, rays, kept, self.stop)
        return self._finish(seen.total, rays)

    def _finish(self, total: March, rays: Rays) -> tuple[mi.Color3f, mi.Float]:
        behind = self.layers[0].background(rays.direction)
        colour = total.radiance + (1 - total.opacity) * behind
        return colour, dr.select(total.opacity >= OPAQUE, total.depth, dr.inf)

    def _state(self, *arguments: Any) -> list[Any]:
        sizes = [dr.width(argument) for argument in arguments]
        states = [layer.state() for layer in self.layers]
        return [self, self.composite, self.stop, sizes, states]
