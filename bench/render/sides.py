"""What a side of a comparison can be asked, and the cameras both sides look through."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.scenes import bundled
from mi_nerfattack.system.memory import peak_memory_mb
from mi_nerfattack.vehicle.route.route import Route

STOP = 1e-3
FOV_DEG = 90.0
COUNTED_RAYS = 1 << 12  # of which the samples of a step are counted


class AbstractSide(ABC):
    """A renderer with one field and one camera, in a process of its own."""

    @abstractmethod
    def forward(self) -> float:
        """Render a frame and return the seconds it took."""

    @abstractmethod
    def backward(self) -> tuple[float, float]:
        """Differentiate a scalar of the image by all parameters.

        Returns:
            seconds of the derivative alone, and of everything from the rays on.
        """

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Return what is not timed: ``samples`` of a frame, settings."""

    def memory(self) -> dict[str, float]:
        """Return the largest resident size of the process so far, in MB."""
        return {"peak_memory_mb": peak_memory_mb()}


class Clock:
    """Measures from where it is made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def per_step(self, count: int) -> dict[str, float]:
        """Return ``seconds`` of time and of all cores' work, one of `count` parts."""
        return {
            "seconds": (time.perf_counter() - self._wall) / count,
            "cpu_seconds": (time.process_time() - self._cpu) / count,
        }


class AbstractTrainer(ABC):
    """A field being fitted to pictures, in a process of its own."""

    @abstractmethod
    def steps(self, count: int) -> dict[str, float]:
        """Do training steps.

        Returns:
            ``seconds``, ``cpu_seconds`` and ``loss`` of a step, means.
        """

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Return what is not timed: ``rays`` and ``samples`` of a step, settings."""

    def memory(self) -> dict[str, float]:
        """Return the largest resident size of the process so far, in MB."""
        return {"peak_memory_mb": peak_memory_mb()}


def route_rays(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Make the rays of the policies' camera at the start of the route `straight`.

    Returns:
        origins and unit directions, each (n, 3) float32, row by row.
    """
    route = Route.from_file(bundled("intersection/routes.json"), "straight")
    pose = mount_matrix(route.pose_at(0.0), CameraMount())[0]
    return pinhole_rays(width, height, FOV_DEG, pose)


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
