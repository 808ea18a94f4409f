"""What sparse points tell of views: how far apart they stand, and what is near."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.projection import project

FAR_DEG = 5.0
"""Gap (see `view_gaps`) beyond which a field is much worse between views than in them:
of photographs of a fox, after short fits, by 3 dB at 2.0, 5 at 3.5, 10 at 7 degrees."""
_POINTS = 500  # of a view, at most
_ENOUGH = 100  # points of a view that tell where they begin
_OUTLIERS_PERCENT = 1.0


def view_gaps(
    cameras: Sequence[Camera],
    camera_to_world: np.ndarray,
    points: np.ndarray,
    others: np.ndarray | None = None,
) -> np.ndarray:
    """Measure the angle from each view to the nearest view that shows the same points.

    The rays of two views to a point enclose an angle. The smaller this angle, the more
    of the point's surroundings do both views show. For each point in a picture, the
    function takes the smallest angle to another view with the point in its picture; it
    takes 180 degrees where no other view has the point. The gap of a view is the median
    over the points in its picture. Occlusion is not considered.

    Args:
        cameras: n intrinsics.
        camera_to_world: (n, 4, 4), OpenCV axes.
        points: (m, 3), sparse points that the views show.
        others: (n,), bool: the views to measure the angle to; None for all.

    Returns:
        (n,), degrees; 180 for a view without points.
    """
    eyes = camera_to_world[:, :3, 3]
    shown = points_shown(cameras, camera_to_world, points)
    usable = np.ones(len(cameras), bool) if others is None else others
    return np.array(
        [
            _gap(i, eyes, shown, usable=usable, points=points)
            for i in range(len(cameras))
        ]
    )


def nearest_points(
    cameras: Sequence[Camera], camera_to_world: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Tell how near to each camera the points in its picture begin.

    Args:
        cameras: n intrinsics.
        camera_to_world: (n, 4, 4), OpenCV axes.
        points: (m, 3), what the views show, sparse.

    Returns:
        (n,), metres: 99 % of the points in a picture are farther away, as structure
        from motion has outliers; 0 where there are fewer than 100.
    """
    shown = points_shown(cameras, camera_to_world, points)
    distances = np.zeros(len(cameras))
    for i in np.flatnonzero(shown.sum(1) >= _ENOUGH):
        away = np.linalg.norm(points[shown[i]] - camera_to_world[i, :3, 3], axis=1)
        distances[i] = np.percentile(away, _OUTLIERS_PERCENT)
    return distances


def points_shown(
    cameras: Sequence[Camera], camera_to_world: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Tell which points (m, 3) each picture has, (n, m)."""
    shown = []
    for camera, pose in zip(cameras, camera_to_world, strict=True):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        shown.append(project(camera, local)[1])
    return np.stack(shown)


def _gap(
    view: int,
    eyes: np.ndarray,
    shown: np.ndarray,
    usable: np.ndarray,
    points: np.ndarray,
) -> float:
    indices = np.flatnonzero(shown[view])
    if not len(indices):
        return 180.0
    indices = indices[:: -(-len(indices) // _POINTS)]
    rays = eyes[:, None] - points[indices]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    cosine = np.where(
        shown[:, indices] & usable[:, None], (rays * rays[view]).sum(2), -1
    )
    cosine[view] = -1
    return float(np.median(np.degrees(np.arccos(np.clip(cosine.max(0), -1, 1)))))
