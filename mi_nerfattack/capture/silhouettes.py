"""Where an object is, from the silhouettes in its images: the visual hull's box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from mi_nerfattack.capture.inputs import find_bounds
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.render.camera.projection import project

_COARSE, _FINE = 32, 64  # cells along each edge: while the box shrinks, and at last
_VIEWS = 48  # at most; fewer cones make the hull larger, never smaller
_PIXELS = 256  # silhouettes are reduced to about this edge
_PASSES = 8
_SEEN_BY = 0.5  # share of the views that must have a point in their frame
_ALPHA = 0.02  # opacity from which a pixel belongs to the object


def check_alpha(images: PosedImages, source: str) -> None:
    """Raise InputError, naming the source, unless the images show a silhouette."""
    if images.channels != 4:
        raise InputError(
            f"{source}: its images have no alpha channel; an object needs RGBA images "
            "with a transparent background (in Blender: Film, Transparent)"
        )
    alpha = [image[..., 3] for image in images.images]
    least, most = min(a.min() for a in alpha), max(a.max() for a in alpha)
    for name, is_uniform, what in (
        ("1", least > 255 * (1 - _ALPHA), "nothing tells object and background"),
        ("0", most < 255 * _ALPHA, "no object is seen"),
    ):
        if is_uniform:
            raise InputError(
                f"{source}: alpha is {name} in all images, so that {what}; render "
                "the object on a transparent background"
            )


def silhouette_bounds(images: PosedImages) -> tuple[np.ndarray, np.ndarray]:
    """Return the box of the visual hull: all points that no view shows as background.

    The hull contains the object, and so does the box; with many views around the
    object it is larger by about a thirtieth. Only points that half of the views have
    in their frame are looked at.

    Args:
        images: RGBA, around the object; see `check_alpha`.

    Returns:
        lower and upper corner, (3,) each, in the unit of the poses.

    Raises:
        InputError: no point is inside of all silhouettes.
    """
    chosen = np.unique(np.linspace(0, len(images) - 1, _VIEWS).round().astype(int))
    silhouettes = [_reduced(images.images[i][..., 3] > 255 * _ALPHA) for i in chosen]
    lower, upper = find_bounds(replace(images, points=None))
    cells = _COARSE
    for _ in range(_PASSES):
        inside = _inside(
            images, chosen, silhouettes, lower=lower, upper=upper, cells=cells
        )
        if not inside.any():
            raise InputError(
                "images: no point lies inside of all silhouettes; check the poses and "
                "the alpha, or give the object's box (--bounds x0 y0 z0 x1 y1 z1)"
            )
        indices = np.stack(np.nonzero(inside))
        cell = (upper - lower) / cells
        low = np.maximum(lower, lower + (indices.min(1) - 1) * cell)
        high = np.minimum(upper, lower + (indices.max(1) + 2) * cell)
        shrunk = np.any(high - low < 0.85 * (upper - lower))
        lower, upper = low, high
        if cells == _FINE:
            break
        cells = _COARSE if shrunk else _FINE
    return lower, upper


def move_views(
    images: PosedImages,
    matrix: np.ndarray,
    scale: float,
    offset: np.ndarray,
) -> PosedImages:
    """Move an object with its cameras: points become ``scale * matrix p + offset``.

    Args:
        images: the posed images.
        matrix: (3, 3), a rotation.
        scale: positive.
        offset: (3,), metres.
    """
    poses = images.camera_to_world.copy()
    poses[:, :3, :3] = matrix @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ matrix.T + offset
    return replace(images, camera_to_world=poses, points=None)


def _inside(
    images: PosedImages,
    chosen: np.ndarray,
    silhouettes: list[tuple[np.ndarray, int]],
    lower: np.ndarray,
    upper: np.ndarray,
    cells: int,
) -> np.ndarray:
    """Mark the cells of a grid that no silhouette excludes, boolean (n, n, n)."""
    unit = (np.arange(cells) + 0.5) / cells
    grid = np.stack(np.meshgrid(unit, unit, unit, indexing="ij"), axis=-1)
    points = lower + grid.reshape(-1, 3) * (upper - lower)
    radius = 0.5 * float(np.linalg.norm((upper - lower) / cells))
    alive = np.arange(len(points))
    view_counts = np.zeros(len(points), int)
    for index, (mask, factor) in zip(chosen, silhouettes, strict=True):
        camera = images.camera_of(index)
        pose = images.camera_to_world[index]
        local = (points[alive] - pose[:3, 3]) @ pose[:3, :3]
        image, valid = project(camera, local)
        view_counts[alive[valid]] += 1
        pixels = max(camera.fx, camera.fy) / factor * radius / local[valid, 2]
        column, row = image[valid].T.astype(int) // factor
        outside = np.zeros(len(alive), bool)
        outside[valid] = ~_touches(mask, row, column, pixels=pixels)
        alive = alive[~outside]
    alive = alive[view_counts[alive] >= _SEEN_BY * len(chosen)]
    inside = np.zeros(len(points), bool)
    inside[alive] = True
    return inside.reshape((cells,) * 3)


def _reduced(mask: np.ndarray) -> tuple[np.ndarray, int]:
    """Reduce a mask to about `_PIXELS`; a pixel is set if one of its parts is."""
    factor = max(1, max(mask.shape) // _PIXELS)
    measure = load_extra("skimage.measure", "the box of an object in images")
    return measure.block_reduce(mask, factor, np.max), factor


def _touches(
    mask: np.ndarray, row: np.ndarray, column: np.ndarray, pixels: np.ndarray
) -> np.ndarray:
    """Tell whether a mask is set within some pixels of points, or a bit further."""
    level = np.ceil(np.log2(np.clip(pixels, 1, max(mask.shape)))).astype(int)
    result = np.zeros(len(row), bool)
    for each in np.unique(level):
        grown = ndimage.maximum_filter(mask, 2 * 2**each + 1)
        at = level == each
        result[at] = grown[row[at], column[at]]
    return result
