"""Camera in a stock Mitsuba scene: path-traced frames, objects pasted by depth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.views.paste import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.pathtrace.views import ViewRenderer

#: Samples of a pixel that are added up in one order whatever the threads do.
_PART = 16


class MitsubaView(AbstractView):
    """Camera at any pose in a scene that its own integrator renders.

    Two views of one scene give equal frames, to the last bit, for equal poses and
    seeds. Mitsuba's film does not promise that: where a pixel's samples are shared
    between threads, their sum has an order that varies. So images are rendered in
    parts of 16, 8, 4, 2 or 1 samples per pixel, and the parts are added up in order.
    After the first frame no kernel is compiled.

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
        rgb, depth = self.linear(camera_to_world, seed)
        image = linear_to_uint8(rgb)
        pose = np.array(camera_to_world, np.float64)
        return self._paster.paste(CameraFrame(image, depth, pose, linear=rgb))

    def linear(
        self, camera_to_world: np.ndarray, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Render one frame without its objects.

        Returns:
            (height, width, 3) linear, exposed, and depth (height, width), metres along
            the ray; float32.
        """
        counts = _sample_counts(self.spp)
        seeds = [seed]
        if len(counts) > 1:
            sequence = np.random.SeedSequence(seed)
            seeds = [int(value) for value in sequence.generate_state(len(counts))]
        views = [
            self.renderer.render(camera_to_world, count, own_seed)
            for count, own_seed in zip(counts, seeds, strict=True)
        ]
        weights = np.array(counts, np.float32) / np.float32(self.spp)
        rgb = sum(w * view.rgb for w, view in zip(weights, views, strict=True))
        gain = np.float32(2.0**self.exposure_ev)
        return np.asarray(gain * rgb), views[0].depth.copy()

    def close(self) -> None:
        """Nothing is held."""


def _sample_counts(spp: int) -> list[int]:
    """Split a number of samples into powers of two, the largest first."""
    counts = [_PART] * (spp // _PART)
    size = _PART // 2
    while size:
        counts += [size] * ((spp % _PART) // size % 2)
        size //= 2
    return counts
