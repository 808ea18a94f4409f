"""Rays through the pixels of a camera at any pose, and straight up or down."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.render.camera.intrinsics import Camera, generate_rays, pose_arrays
from mi_nerfattack.render.rays import Rays


class PixelRays:
    """Rays of one image after the other; the launch is recorded once.

    Args:
        camera: intrinsics.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._frozen = freeze_method(self._record, self._state)

    def at(self, camera_to_world: np.ndarray) -> Rays:
        """Make the rays of one image, row by row from the top left.

        Args:
            camera_to_world: (4, 4), OpenCV axes, metres.

        Returns:
            height * width rays without end; samples in the middle of their intervals.
        """
        return self._frozen(*pose_arrays(camera_to_world))

    def _record(self, origin: mi.Point3f, columns: Any) -> Rays:
        origins, directions = generate_rays(self.camera, origin, columns, 1)
        far, middle = dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Float, 0.5)
        return Rays(origins, directions, far, middle, dr.opaque(mi.Bool, True))

    def _state(self, origin: mi.Point3f, columns: Any) -> list[Any]:
        del origin, columns
        return [self, self.camera]


def vertical_reach(
    scene: Any, points: np.ndarray, from_m: float, up: bool = False
) -> np.ndarray:
    """Return how far (n,) the first surface is below points or above; inf for none.

    Args:
        scene: `mi.Scene`.
        points: (n, 2), metres.
        from_m: height of the points, metres.
        up: look upwards.
    """
    x, y = upload_rows(mi.Point2f, points)
    ray = mi.Ray3f(mi.Point3f(x, y, from_m), mi.Vector3f(0, 0, 1 if up else -1))
    return scene.ray_intersect_preliminary(ray, coherent=False).t.numpy()
