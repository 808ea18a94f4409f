"""What a fit starts from besides the images: depth maps and the field's box."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_nerfattack import files
from mi_nerfattack.capture.fit_cells import depth_points
from mi_nerfattack.capture.frames import PosedImages
from mi_nerfattack.errors import InputError

_CUBE = 2.0  # half edge of the cube, in distances of the farthest camera
_MARGIN = 0.01  # around the box of all depth points, of its longest edge
_MIN_MARGIN_M = 0.05


def read_depth(folder: str | Path, images: PosedImages) -> np.ndarray | None:
    """Read the depth maps that ``depth_file`` in a folder's transforms.json names.

    Args:
        folder: the folder of `transforms.json`, or the JSON file.
        images: as read from there; depth is picked at their pixels' centres.

    Returns:
        (n, height, width), float32, metres along the ray, infinite where nothing is
        hit; None if the folder has no depth file.

    Raises:
        InputError: the file lacks the tensor ``depth``, its shape contradicts the
            images, or a depth is not positive.
    """
    path = Path(folder)
    source = path / "transforms.json" if path.is_dir() else path
    if not source.is_file():
        return None
    name = files.read_json(source).get("depth_file")
    if name is None:
        return None
    if not isinstance(name, str):
        raise InputError(f"{source}: depth_file: {name!r}; needs a path")
    where = source.parent / name
    depth = files.read_safetensors(where)[0].get("depth")
    if depth is None or depth.ndim != 3 or len(depth) != len(images):
        shape = None if depth is None else depth.shape
        raise InputError(
            f"{where}: tensor 'depth' has shape {shape}; needs one map for each of "
            f"{len(images)} images; remove depth_file from {source} to fit without"
        )
    if not (depth > 0).all():
        raise InputError(f"{where}: tensor 'depth' holds NaN or a depth of 0 or less")
    height, width = depth.shape[1:]
    camera = images.camera
    rows = ((np.arange(camera.height) + 0.5) * height / camera.height).astype(int)
    columns = ((np.arange(camera.width) + 0.5) * width / camera.width).astype(int)
    return depth[:, rows][:, :, columns]


def find_bounds(
    images: PosedImages,
    depth: np.ndarray | None = None,
    given: Sequence[float] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Choose the box of a field.

    Given bounds win. With depth, the box of all points seen, and 1 % of its longest
    edge (at least 5 cm) around it. Otherwise a cube around the point nearest to all
    optical axes; its half edge is twice the distance of the farthest camera.

    Args:
        images: the posed images.
        depth: (n, height, width), metres along the ray, or None.
        given: x0, y0, z0, x1, y1, z1, metres, or None.

    Returns:
        lower and upper corner, (3,) each, metres.

    Raises:
        InputError: the given bounds are out of order, or the optical axes are
            parallel, so that no point is nearest to them.
    """
    if given is not None:
        lower, upper = np.array(given[:3], float), np.array(given[3:], float)
        if not (np.isfinite(given).all() and (lower < upper).all()):
            raise InputError(
                f"bounds: {list(given)}; must be x0 y0 z0 x1 y1 z1 with x0 < x1, ..."
            )
        return lower, upper
    if depth is not None and np.isfinite(depth).any():
        return _box_of_points(images, depth)
    focus = _focus(images.camera_to_world)
    reach = np.linalg.norm(images.camera_to_world[:, :3, 3] - focus, axis=1).max()
    return focus - _CUBE * reach, focus + _CUBE * reach


def _box_of_points(
    images: PosedImages, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    corners = [
        (block.min(0), block.max(0))
        for block in depth_points(images, depth, range(len(images)))
        if len(block)
    ]
    lower = np.min([low for low, _ in corners], axis=0)
    upper = np.max([high for _, high in corners], axis=0)
    margin = max(_MIN_MARGIN_M, _MARGIN * float((upper - lower).max()))
    return lower - margin, upper + margin


def _focus(camera_to_world: np.ndarray) -> np.ndarray:
    """Return the point with the least squared distance to all optical axes, (3,)."""
    axes, eyes = camera_to_world[:, :3, 2], camera_to_world[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix = across.mean(0)
    if np.linalg.cond(matrix) > 1e4:
        raise InputError(
            "camera poses: all cameras look in one direction, so no centre can be "
            "found; give the field's box (--bounds x0 y0 z0 x1 y1 z1)"
        )
    return np.linalg.solve(matrix, (across @ eyes[:, :, None]).mean(0)[:, 0])
