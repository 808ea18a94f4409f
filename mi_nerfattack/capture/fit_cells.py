"""Cells that a fit may fill, as far as depth maps tell."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mi_nerfattack.capture.frames import PosedImages
from mi_nerfattack.render.camera import generate_rays, pose_arrays

_UPSAMPLING = 4
_SMOOTH_RATIO = 1.5  # neighbours with depths closer than this lie on one surface


def grid_shape(
    lower: np.ndarray, upper: np.ndarray, resolution: int
) -> tuple[int, int, int]:
    """Return the cells along each axis, `resolution` along the longest.

    No axis has fewer than half of that: in the flat box of a street the surfaces lie
    flat too, and a ray above the ground should meet few occupied cells.
    """
    extent = np.asarray(upper, float) - lower
    wanted = np.round(resolution * extent / extent.max())
    x, y, z = np.maximum((resolution + 1) // 2, wanted).astype(int)
    return int(x), int(y), int(z)


def depth_points(
    images: PosedImages, depth: np.ndarray, indices: Iterable[int], reach_m: float = 0.0
) -> Iterable[np.ndarray]:
    """Yield points (n, 3), metres, on the surfaces that depth maps show.

    Between neighbouring pixels on one surface points are interpolated, linear in
    inverse depth, since pixels at a grazing angle lie far apart.

    Args:
        images: the posed images.
        depth: (n, height, width), metres along the ray; infinite or unknown (NaN)
            depths give no point.
        indices: of the images to use.
        reach_m: also yield the points this far before and behind the surface.
    """
    for index in indices:
        origin, rotation = pose_arrays(images.camera_to_world[index])
        camera = images.camera_of(index)
        direction = generate_rays(camera, origin, rotation, 1)[1].numpy()
        ray = direction.reshape(3, camera.height, camera.width).astype(np.float64)
        inverse = np.where(np.isfinite(depth[index]), 1 / depth[index], 0.0)
        eye = images.camera_to_world[index, :3, 3]
        for unit, t in (*_between(ray, inverse, 1), *_between(ray, inverse, 2)):
            for offset in {0.0, -reach_m, reach_m}:
                yield eye + ((t + offset) * unit).T


def _between(
    ray: np.ndarray, inverse: np.ndarray, axis: int
) -> Iterable[tuple[np.ndarray, np.ndarray]]:
    """Yield directions (3, n) and depths (n,) between neighbours along an axis."""
    first = [slice(None)] * 3
    second = [slice(None)] * 3
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    a, b = inverse[tuple(first[1:])], inverse[tuple(second[1:])]
    both = (a > 0) & (b > 0)
    joined = both & (np.maximum(a, b) < _SMOOTH_RATIO * np.minimum(a, b))
    ray_a, ray_b = ray[tuple(first)], ray[tuple(second)]
    for k in range(_UPSAMPLING):
        share = k / _UPSAMPLING
        used = joined if k else a > 0
        mixed = (1 - share) * ray_a[:, used] + share * ray_b[:, used]
        t = 1 / ((1 - share) * a[used] + share * b[used])
        yield mixed / np.linalg.norm(mixed, axis=0), t


def cells_near_surfaces(
    points: Iterable[np.ndarray],
    lower: np.ndarray,
    upper: np.ndarray,
    shape: tuple[int, int, int],
) -> np.ndarray:
    """Mark the cells of a grid over a box that hold a point; boolean `shape`."""
    cells = np.zeros(shape, bool)
    for block in points:
        cell = np.floor((block - lower) / (upper - lower) * shape).astype(np.int64)
        inside = ((cell >= 0) & (cell < shape)).all(axis=1)
        cells[tuple(cell[inside].T)] = True
    return cells
