"""The cameras that both sides of a comparison look through."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route

STOP = 1e-3  # transmittance at which a ray ends
FOV_DEG = 90.0


def route_rays(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Make the rays of the policies' camera at the start of the route `straight`.

    Returns:
        origins and unit directions, each (n, 3) float32, row by row.
    """
    route = Route.from_file(bundled("intersection/routes.json"), "straight")
    pose = mount_matrix(route.pose_at(0.0), CameraMount())[0]
    return pinhole_rays(width, height, FOV_DEG, camera_to_world=pose)


def pinhole_rays(
    width: int, height: int, fov_x_deg: float, camera_to_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Make a ray through the centre of every pixel.

    Args:
        width: pixels.
        height: pixels.
        fov_x_deg: horizontal field of view.
        camera_to_world: (4, 4), OpenCV axes.

    Returns:
        origins and unit directions, each (n, 3) float32, row by row.
    """
    camera = from_fov(width, height, fov_x_deg)
    row, column = np.divmod(np.arange(width * height), width)
    x = (column + 0.5 - camera.cx) / camera.fx
    y = (row + 0.5 - camera.cy) / camera.fy
    local = np.stack([x, y, np.ones_like(x)], 1)
    direction = local @ camera_to_world[:3, :3].T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.broadcast_to(camera_to_world[:3, 3], direction.shape)
    return origin.astype(np.float32), direction.astype(np.float32)
