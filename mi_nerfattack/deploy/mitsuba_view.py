"""Camera in a stock Mitsuba scene: path-traced frames, objects pasted by depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.capture.views import ViewRenderer
from mi_nerfattack.colour import linear_to_uint8
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.paste import Paster
from mi_nerfattack.deploy.view import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import Camera
from mi_nerfattack.render.posed import PosedField


class MitsubaView(AbstractView):
    """Camera at any pose in a scene that its own integrator renders.

    Two views of one scene give equal frames for equal poses and seeds. After the
    first frame no kernel is compiled.

    Args:
        scene: `mi.Scene`, metric, z up.
        camera: intrinsics.
        spp: samples per pixel.
        exposure_ev: the image's radiance is multiplied by two to this power; that of
            pasted objects is not.
    """

    def __init__(
        self, scene: Any, camera: Camera, spp: int = 16, exposure_ev: float = 0.0
    ) -> None:
        if spp < 1:
            raise InputError(f"spp: {spp}; at least 1 sample per pixel")
        if not math.isfinite(exposure_ev):
            raise InputError(f"exposure_ev: {exposure_ev}; must be finite")
        self.camera, self.spp, self.exposure_ev = camera, spp, exposure_ev
        self.renderer = ViewRenderer(scene, camera)
        self.show(())

    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        """Render one frame; see :meth:`AbstractView.render`."""
        view = self.renderer.render(camera_to_world, self.spp, seed)
        image = linear_to_uint8(view.rgb * np.float32(2.0**self.exposure_ev))
        pose = np.array(camera_to_world, np.float64)
        return self._paster.paste(CameraFrame(image, view.depth.copy(), pose))

    def show(self, objects: Sequence[PosedField]) -> None:
        """Paste other fields."""
        self._paster = Paster(self.camera, objects)

    def close(self) -> None:
        """Nothing is held."""
