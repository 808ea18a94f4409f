"""What a fit starts from besides the images: depth maps and the field's box."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.posed_images import PosedImages, stacked
from mi_nerfattack.capture.transforms import (
    FILE_NAMES,
    find_transforms,
    named_path,
    read_table,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import exr, files
from mi_nerfattack.render.camera.intrinsics import Camera, ray_lengths
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays

_CUBE = 2.0  # half edge of the cube, in distances of the farthest camera
_MARGIN = 0.01  # around the box of all depth points, of its longest edge
_MIN_MARGIN_M = 0.05
_FAR_MARGIN = 1 / 128  # of the largest depth: what an NGP's march steps there
_MILLIMETRE = 1e-3
_FAR_M = 300.0  # a median depth that no photograph of a place has, but its millimetres
_NOTHING_M = 1e9  # from here on, depth stands for no surface, as Blender's 1e10
_POINTS_PERCENT = 2.0  # of the points on either side of each axis are outliers
_POINTS_MARGIN = 0.1  # around the box of points and cameras, of its longest edge


def read_depth(folder: str | Path, images: PosedImages) -> np.ndarray | None:
    """Read the depth maps that the transforms.json of a folder names.

    The JSON file names the depth maps by one of two keys:

    - ``depth_file``, the key of this project, names a safetensors file. Its tensor
      ``depth`` holds one map for each frame, in metres along the ray.
    - ``depth_file_path`` of each frame, the key of nerfstudio, names a map of depths
      along the optical axis. A PNG of 16 bits or a ``.npy`` of integers holds whole
      millimetres; an EXR or a ``.npy`` of real numbers holds metres. A depth of 0 or
      less, or NaN, is unknown. A depth over a million kilometres means that the ray
      hits no surface.

    A map may be larger or smaller than its image; each pixel takes the nearest value.

    Args:
        folder: the folder of `transforms.json`, or the JSON file; any other folder has
            no depth.
        images: as read from there.

    Returns:
        n maps (height, width), float32, as `stacked` puts them together, metres along
        the ray: infinite where the ray hits nothing, NaN where the depth is unknown.
        None if the JSON file names no depth.

    Raises:
        InputError: a file is missing or cannot be read, there is not a map for each
            frame, or a depth is not positive.
    """
    path = Path(folder)
    with files.reported(path):
        if path.is_dir() and not any((path / name).is_file() for name in FILE_NAMES):
            return None
    source = find_transforms(path)
    table, frames = read_table(source)
    used = _frames_of(source, frames, images)
    if table.get("depth_file") is not None:
        return _read_own(
            source, table["depth_file"], len(frames), used=used, images=images
        )
    if any(frames[i].get("depth_file_path") is not None for i in used):
        maps = [
            _read_axial(
                source, i, frames[i].get("depth_file_path"), images=images, index=k
            )
            for k, i in enumerate(used)
        ]
        return stacked(maps)
    return None


def _frames_of(source: Path, frames: Sequence[Any], images: PosedImages) -> list[int]:
    """Return the frames of the images, which leave out those that are missing."""
    missing = set(images.missing)
    used = [i for i, frame in enumerate(frames) if frame["file_path"] not in missing]
    if len(used) != len(images):
        raise InputError(
            f"{source}: frames: {len(used)} with an image, but {len(images)} images "
            "were given; read images and depth from one folder"
        )
    return used


def _read_own(
    source: Path, name: Any, n_frames: int, used: list[int], images: PosedImages
) -> np.ndarray:
    where = named_path(source, "depth_file", name)
    depth = files.read_safetensors(where)[0].get("depth")
    if depth is None or depth.ndim != 3 or len(depth) != n_frames:
        shape = None if depth is None else depth.shape
        raise InputError(
            f"{where}: tensor 'depth' has shape {shape}; needs one map for each of "
            f"{n_frames} frames; remove depth_file from {source} to fit without"
        )
    if (depth <= 0).any():
        raise InputError(
            f"{where}: tensor 'depth' holds a depth of 0 or less; write infinity where "
            "nothing is hit, and NaN where it is unknown"
        )
    return stacked(
        [_at_pixels(depth[i], images.camera_of(k)) for k, i in enumerate(used)]
    )


def _read_axial(
    source: Path, frame: int, name: Any, images: PosedImages, index: int
) -> np.ndarray:
    """Read depth along the optical axis and turn it into depth along the rays."""
    camera = images.camera_of(index)
    if name is None:
        return np.full((camera.height, camera.width), np.nan, np.float32)
    where = named_path(source, f"frames[{frame}].depth_file_path", name)
    reader = _AXIAL.get(where.suffix.lower())
    if reader is None:
        raise InputError(
            f"{source}: frames[{frame}].depth_file_path: {name!r}; must be a PNG of 16 "
            "bits (millimetres), an EXR or .npy file (metres)"
        )
    stored = _at_pixels(reader(where), camera)
    axial = stored.astype(np.float64)
    axial *= _MILLIMETRE if stored.dtype.kind in "ui" else 1
    surface_depths = axial[(axial > 0) & (axial < _NOTHING_M)]
    if surface_depths.size and (middle := np.median(surface_depths)) > _FAR_M:
        raise InputError(
            f"{where}: half of the depths are beyond {middle:.0f} m; "
            "real numbers are metres here, and millimetres in nerfstudio by default: "
            "divide them by 1000"
        )
    depth = np.where(axial > 0, axial * ray_lengths(camera), np.nan)
    return np.where(axial > _NOTHING_M, np.inf, depth).astype(np.float32)


def _read_exr(path: Path) -> np.ndarray:
    """Read the depth (h, w) of an EXR file, metres: its Z, or its only channel."""
    layers = exr.read_layers(path)[0]
    maps = {name: layer for name, layer in layers.items() if layer.ndim == 2}
    named = [name for name in maps if name.rpartition(".")[2] == "Z"] or list(maps)
    if len(named) != 1:
        raise InputError(
            f"{path}: layers {', '.join(map(repr, layers))}; depth is a channel Z, or "
            "the only channel"
        )
    return maps[named[0]]


def _read_npy(path: Path) -> np.ndarray:
    """Read a NumPy file of one plane of numbers, (height, width)."""
    raw = io.BytesIO(files.read_bytes(path, files.MAX_IMAGE_BYTES))
    try:
        version = np.lib.format.read_magic(raw)
        older = version == (1, 0)
        form = np.lib.format
        read = form.read_array_header_1_0 if older else form.read_array_header_2_0
        shape, by_columns, kind = read(raw)
        if kind.kind not in "uif" or len([n for n in shape if n != 1]) > 2:
            raise ValueError(f"{kind} {shape}; needs numbers (height, width)")
        data = raw.read()
        flat = np.frombuffer(data, kind, int(np.prod(shape, dtype=object)))
        array = flat.reshape(shape, order="F" if by_columns else "C")
        while array.ndim > 2:
            array = array.squeeze(array.shape.index(1))
        if array.ndim != 2:
            raise ValueError(f"{shape}; needs (height, width)")
        return array
    # a damaged header makes NumPy raise whatever its parser stumbles over
    except Exception as err:
        raise InputError(f"{path}: not a NumPy file of a plane ({err})") from err


_AXIAL = {".png": files.read_image16, ".exr": _read_exr, ".npy": _read_npy}


def _at_pixels(values: np.ndarray, camera: Camera) -> np.ndarray:
    """Pick the values of a map (h, w) at the centres of a camera's pixels."""
    height, width = values.shape
    rows = ((np.arange(camera.height) + 0.5) * height / camera.height).astype(int)
    columns = ((np.arange(camera.width) + 0.5) * width / camera.width).astype(int)
    return values[rows][:, columns]


def find_bounds(
    images: PosedImages,
    depth: np.ndarray | None = None,
    bounds: Sequence[float] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Choose the box of a field.

    Given bounds win. With depth, the box of all points seen, and 1 % of its longest
    edge (at least 5 cm and a 128th of the largest depth) around it. With sparse points,
    the box of all cameras and of the points without the outermost 2 % on either side,
    and 10 % around it. Otherwise a cube around the point nearest to all optical axes;
    its half edge is twice the distance of the farthest camera.

    Args:
        images: the posed images, perhaps with sparse points.
        depth: (n, height, width), metres along the ray, NaN where unknown; or None.
        bounds: x0, y0, z0, x1, y1, z1, metres, or None.

    Returns:
        lower and upper corner, (3,) each, metres.

    Raises:
        InputError: the given bounds are out of order, or the optical axes are
            parallel, so that no point is nearest to them.
    """
    if bounds is not None:
        lower, upper = np.array(bounds[:3], float), np.array(bounds[3:], float)
        if not (np.isfinite(bounds).all() and (lower < upper).all()):
            raise InputError(
                f"bounds: {list(bounds)}; must be x0 y0 z0 x1 y1 z1 with x0 < x1, ..."
            )
        return lower, upper
    box = None if depth is None else _box_of_points(images, depth)
    if box is not None:
        return box
    if images.points is not None and len(images.points) > 0:
        return _box_of_sparse(images.points, images.camera_to_world[:, :3, 3])
    focus = _focus(images.camera_to_world)
    reach = np.linalg.norm(images.camera_to_world[:, :3, 3] - focus, axis=1).max()
    return focus - _CUBE * reach, focus + _CUBE * reach


def _box_of_points(
    images: PosedImages, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the box of the points of depth maps, None where there are none."""
    ends = []
    for eye, rays in depth_rays(images, depth, range(len(images))):
        hits = rays[rays[..., 3] > 0].astype(np.float64)
        if len(hits):
            t = 1 / hits[:, 3:]
            points = eye + t * hits[:, :3]
            ends.append((points.min(0), points.max(0), t.max()))
    if not ends:
        return None
    lower = np.min([low for low, _, _ in ends], axis=0)
    upper = np.max([high for _, high, _ in ends], axis=0)
    room = _FAR_MARGIN * max(float(far) for _, _, far in ends)
    margin = max(_MIN_MARGIN_M, _MARGIN * float((upper - lower).max()), room)
    return lower - margin, upper + margin


def _box_of_sparse(
    points: np.ndarray, eyes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    ends = np.percentile(points, [_POINTS_PERCENT, 100 - _POINTS_PERCENT], axis=0)
    lower, upper = np.minimum(ends[0], eyes.min(0)), np.maximum(ends[1], eyes.max(0))
    margin = _POINTS_MARGIN * float((upper - lower).max())
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


def depth_rays(
    images: PosedImages, depth: np.ndarray, indices: Iterable[int]
) -> Iterable[tuple[np.ndarray, np.ndarray]]:
    """Yield the rays of images with the inverse of the distances that depth maps show.

    Args:
        images: the posed images.
        depth: (n, height, width), metres along the ray, infinite where nothing is hit
            and NaN where it is unknown.
        indices: of the images to use.

    Returns:
        for each image the origin of its rays (3,), metres, and (height, width, 4),
        float32: their unit directions, and 1 / metre; 0 without a surface.
    """
    for index in indices:
        camera, pose = images.camera_of(index), images.camera_to_world[index]
        direction = generate_rays(camera, *pose_arrays(pose), 1)[1].numpy()
        direction = direction.T.reshape(camera.height, camera.width, 3)
        inverse = np.where(np.isfinite(depth[index]), 1 / depth[index], 0)
        rays = np.concatenate([direction, inverse[..., None]], 2)
        yield pose[:3, 3], rays.astype(np.float32)
