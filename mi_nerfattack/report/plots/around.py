"""An object seen from all around, a little from above."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import drjit as dr
import numpy as np

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    generate_rays,
    look_at,
    pose_arrays,
)
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

ELEVATION_DEG = 15.0
DISTANCE = 4.0  # of the eye from the object's centre, in radii of its box
PAPER = np.array([1.0, 1.0, 1.0])


class Around:
    """Eyes around a box, whose frames it just fits in.

    Args:
        lower: (3,), corner of the box in the object's frame, metres.
        upper: likewise.
        azimuths_deg: of the eyes, about z from +x.
        edge_px: longer edge of the frames.
    """

    def __init__(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        azimuths_deg: Sequence[float],
        edge_px: int,
    ) -> None:
        self._poses = [_pose(lower, upper, azimuth) for azimuth in azimuths_deg]
        self._camera = _camera(lower, upper, self._poses, edge_px)

    def views(self, field: AbstractField) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield premultiplied radiance (height, width, 3) and opacity by eye."""
        posed, camera = PosedField(field), self._camera
        shape = (camera.height, camera.width)
        for pose in self._poses:
            origin, direction = generate_rays(camera, *pose_arrays(pose), 1)
            seen = march(posed, Rays(origin, direction))
            dr.eval(seen.radiance, seen.opacity)
            radiance = seen.radiance.numpy().T.reshape(*shape, 3)
            yield radiance.copy(), seen.opacity.numpy().reshape(shape).copy()


def turntable(grid: GridField, count: int, edge_px: int) -> list[np.ndarray]:
    """Render an object from all around.

    Args:
        grid: with the texture that is to be seen.
        count: of the eyes, equally spaced from +x on.
        edge_px: longer edge of the views.

    Returns:
        sRGB images over white, (height, width, 3), uint8.
    """
    azimuths = np.linspace(0, 360, count, endpoint=False)
    around = Around(grid.lower, grid.upper, azimuths.tolist(), edge_px)
    views = [over_paper(*look) for look in around.views(grid)]
    return [(255 * view).round().astype(np.uint8) for view in views]


def over_paper(radiance: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Lay a view over white: sRGB in [0, 1]."""
    over = radiance + (1 - opacity[..., None]) * PAPER
    return linear_to_srgb_numpy(over).clip(0, 1)


def _pose(lower: np.ndarray, upper: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Place an eye, camera_to_world (4, 4)."""
    centre = 0.5 * (lower + upper)
    distance = DISTANCE * 0.5 * float(np.linalg.norm(upper - lower))
    azimuth, elevation = np.radians(azimuth_deg), np.radians(ELEVATION_DEG)
    level = np.cos(elevation)
    outwards = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
    return look_at(centre + distance * np.array(outwards), centre)


def _camera(
    lower: np.ndarray, upper: np.ndarray, poses: Sequence[np.ndarray], edge_px: int
) -> Camera:
    """Make the camera whose frame the box just fits in from all poses."""
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), -1)
    corners = corners.reshape(-1, 3)
    slopes = []
    for pose in poses:
        local = (corners - pose[:3, 3]) @ pose[:3, :3]
        slopes.append(np.abs(local[:, :2] / local[:, 2:]).max(axis=0))
    reach = np.max(slopes, axis=0)
    focal = 0.5 * edge_px / reach.max()
    width, height = (max(1, int(size)) for size in np.ceil(2 * focal * reach))
    return Camera(width, height, focal, focal, width / 2, height / 2)
