"""Pictures of a place from above, in the surrogate and in a Mitsuba scene."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.render.camera.conventions import mitsuba_sensor_dict
from mi_nerfattack.render.camera.intrinsics import Camera, ray_lengths
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.render.pathtrace.ground import vertical_reach
from mi_nerfattack.render.pathtrace.views import require_colour
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.vehicle.dynamics import to_state


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
        origins, directions = generate_rays(self.camera, origin, columns, n_poses=1)
        far, middle = dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Float, 0.5)
        return Rays(
            origins, directions, far, jitter=middle, active=dr.opaque(mi.Bool, True)
        )

    def _state(self, origin: mi.Point3f, columns: Any) -> list[Any]:
        del origin, columns
        return [self.camera]


#: What is higher is left out of the surrogate's picture, metres: from where no view
#: was fitted, fields hold matter that no view sees.
TOP_M = 4.0
_NEAR_M, _FAR_M = 0.01, 1e5


def surrogate_above(
    sensor: SceneSensor, overhead: Overhead, top_m: float = TOP_M
) -> np.ndarray:
    """Render the surrogate and its objects from above.

    Args:
        sensor: gives the scene.
        overhead: camera.
        top_m: what is higher is left out.

    Returns:
        (height, width, 3), uint8, sRGB.
    """
    spp = math.ceil(math.sqrt(sensor.camera.spp)) ** 2
    described = mitsuba_sensor_dict(overhead.camera, np.eye(4), spp)
    clip = {"near_clip": max(overhead.height_m - top_m, _NEAR_M), "far_clip": _FAR_M}
    above = SceneSensor(
        sensor.scene,
        overhead.mount,
        sensor=mi.load_dict({**described, **clip}),
        integrator=sensor.integrator,
        centred=True,
    )
    image = above.observe(to_state(overhead.state[None]), 0).image
    return np.round(255 * np.array(image)[0].clip(0, 1)).astype(np.uint8)


def scene_above(
    scene: Any,
    overhead: Overhead,
    open_at: np.ndarray,
    spp: int = 16,
) -> CameraFrame:
    """Render a Mitsuba scene from above; what hides the open ground is left out.

    A `Paster` of the same camera puts objects into the frame.

    Args:
        scene: `mi.Scene`, metric, z up.
        overhead: camera.
        open_at: (n, 2), metres, points of the ground to see: below a ceiling, too.
        spp: samples per pixel.
    """
    require_colour()
    camera, pose = overhead.camera, overhead.camera_to_world
    near = max(overhead.height_m - _lid(scene, open_at), 0.01)
    description = mitsuba_sensor_dict(camera, pose, spp)
    clip = {"near_clip": near, "far_clip": _FAR_M}
    sensor = mi.load_dict({**description, **clip})
    image: Any = mi.render(scene, sensor=sensor, spp=spp, seed=mi.UInt32(0))
    linear = np.array(image)[..., :3]
    rays = PixelRays(camera).at(pose)
    start = mi.Float((near * ray_lengths(camera)).ravel().tolist())
    ray = mi.Ray3f(rays.origin + start * rays.direction, rays.direction)
    t = start + scene.ray_intersect_preliminary(ray, coherent=True).t
    depth = dr.select(dr.isfinite(t), t, dr.inf).numpy().reshape(linear.shape[:2])
    return CameraFrame(linear_to_uint8(linear), depth, pose, linear=linear)


def _lid(scene: Any, points: np.ndarray, from_m: float = 2.0) -> float:
    """Return the height below which points (n, 2) are seen from above, metres."""
    top = float(scene.bbox().max[2]) + 1.0
    free = vertical_reach(scene, points, from_m, up=True)
    return min(top, from_m + float(free.min()) - 0.05)
