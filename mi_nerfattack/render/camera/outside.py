"""Cameras outside of the car: from above, to scale, and from behind.

Both are pinholes at a pose that a car's own camera could have, so that whatever renders
that one renders these.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix

_DISTANCE = 20.0  # of the camera, in widths of what it shows: 1.4 degrees at the rim


@dataclass(frozen=True)
class Overhead:
    """A camera straight above, so far away that it is nearly orthographic.

    Pixels are squares of the plane z = 0, x to the right, y up. What is h metres high
    is shown larger by h / height_m, and up to h / 28 metres farther from the middle.

    Attributes:
        low: (x, y) of the lower left corner of the picture, metres.
        metres_per_px: edge of a pixel on the plane z = 0.
        width, height: of the picture, pixels.
    """

    low: tuple[float, float]
    metres_per_px: float
    width: int
    height: int

    @staticmethod
    def covering(points: np.ndarray, margin_m: float, longest_px: int) -> Overhead:
        """Frame points.

        Args:
            points: (n, 2), metres.
            margin_m: around the outermost points, metres.
            longest_px: of the longer edge.
        """
        # Pixels are square; the shorter edge gets as many as it needs
        low, high = points.min(0) - margin_m, points.max(0) + margin_m
        edge = float((high - low).max()) / longest_px
        width, height = np.ceil((high - low) / edge - 1e-9).astype(int).tolist()
        return Overhead((float(low[0]), float(low[1])), edge, width, height=height)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top on the ground, metres."""
        (x, y), edge = self.low, self.metres_per_px
        return x, x + edge * self.width, y, y + edge * self.height

    @property
    def height_m(self) -> float:
        """Of the camera above z = 0."""
        return _DISTANCE * self.metres_per_px * max(self.width, self.height)

    @property
    def camera(self) -> Camera:
        """Intrinsics."""
        focal = self.height_m / self.metres_per_px
        cx, cy = self.width / 2, self.height / 2
        return Camera(self.width, self.height, fx=focal, fy=focal, cx=cx, cy=cy)

    @property
    def mount(self) -> CameraMount:
        """Of the camera on a car whose state is `state`."""
        return CameraMount(self.height_m, 0.0, 90.0)

    @property
    def state(self) -> np.ndarray:
        """State (3,) of a car with this camera on it."""
        left, right, bottom, top = self.extent
        return np.array([(left + right) / 2, (bottom + top) / 2, math.pi / 2])

    @property
    def camera_to_world(self) -> np.ndarray:
        """Pose (4, 4), OpenCV axes, metres."""
        return mount_matrix(self.state, self.mount)[0]

    def to_px(self, points: np.ndarray) -> np.ndarray:
        """Map points (n, 2) of the plane z = 0, metres, to the picture, (n, 2)."""
        left, _, _, top = self.extent
        # Rows count downwards from the top, y upwards
        offset = np.asarray(points, np.float64) - [left, top]
        return offset * [1, -1] / self.metres_per_px


def chase_mount(car_width_m: float) -> CameraMount:
    """Mount a camera behind and above a car, which it follows.

    It sees car and road with a field of view of about 70 degrees.

    Args:
        car_width_m: distances are in proportion; 9 m behind a car of 1.8 m.
    """
    return CameraMount(2.2 * car_width_m, -5 * car_width_m, 14.0)


def seen_at(
    camera: Camera, camera_to_world: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Project points of the world, for drawing; lenses count as without distortion.

    Args:
        camera: intrinsics.
        camera_to_world: (4, 4), OpenCV axes.
        points: (n, 3), metres.

    Returns:
        (n, 2) pixels from the top left corner; NaN behind the camera.
    """
    at = np.asarray(points, np.float64) - camera_to_world[:3, 3]
    x, y, z = (at @ camera_to_world[:3, :3]).T
    z = np.where(z > 0.05, z, np.nan)
    return np.stack(
        [camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z], axis=1
    )
