"""Folders of posed images: `transforms.json` of nerfstudio, Instant-NGP, Blender.

In memory poses are OpenCV camera-to-world matrices; in the file they are OpenGL.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.colmap.model import MODEL_FOLDERS, find_model, read_colmap
from mi_nerfattack.capture.coverage import points_shown
from mi_nerfattack.capture.intrinsics import intrinsics_table, read_cameras
from mi_nerfattack.capture.masks import load_masks
from mi_nerfattack.capture.posed_images import (
    PosedImages,
    differing,
    load_images,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.splats import read_points
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near
from mi_nerfattack.render.camera.conventions import opencv_to_opengl, opengl_to_opencv
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.pose import nearest_rigid

FILE_NAMES = ("transforms.json", "transforms_train.json")
"""What the JSON file of a folder may be called; the first that is there is read."""


def read_images(
    path: str | Path, long_edge_px: int | None = None, skip_missing: bool = False
) -> PosedImages:
    """Read posed images, in whatever form a folder holds them.

    Args:
        path: a JSON file or a folder with one (`read_transforms`), which comes first,
            or a folder with a COLMAP model (`colmap.read_colmap`).
        long_edge_px: reduce images to this longer edge, in pixels; None keeps them.
        skip_missing: leave out frames without an image file.

    Raises:
        InputError: nothing of these is there, or it cannot be read.
    """
    folder = Path(path)
    with files.reported(path):
        has_no_json = folder.is_dir() and not _json_in(folder)
    if has_no_json:
        model = find_model(folder)
        if model is None:
            raise InputError(_nothing_found(folder))
        return read_colmap(folder, long_edge_px, skip_missing)
    return read_transforms(folder, long_edge_px, skip_missing)


def _nothing_found(folder: Path) -> str:
    with files.reported(folder):
        photographs = [
            item
            for sub in (folder, folder / "images")
            for item in (sub.iterdir() if sub.is_dir() else ())
            if item.suffix.lower() in files.IMAGE_SUFFIXES
        ]
    advice = (
        f"it holds {len(photographs)} photographs: estimate their poses with "
        f"'mi-nerfattack capture photographs {photographs[0].parent} -o FOLDER'"
        if photographs
        else "give the folder that holds one of them"
    )
    return (
        f"{folder}: no posed images; looked for {' or '.join(FILE_NAMES)}, and for a "
        f"COLMAP model (cameras and images, .bin or .txt) in {', '.join(MODEL_FOLDERS)}"
        f"; {advice}"
    )


def _json_in(folder: Path) -> Path | None:
    paths = [folder / name for name in FILE_NAMES if (folder / name).is_file()]
    return paths[0] if paths else None


def read_transforms(
    path: str | Path, long_edge_px: int | None = None, skip_missing: bool = False
) -> PosedImages:
    """Read a folder of posed images.

    Reads intrinsics at the top level or in the frames (see
    `intrinsics.read_cameras`). Images are reduced by averaging areas in linear light;
    they are never enlarged. A frame's `mask_path` names its mask; see `masks`.

    Args:
        path: JSON file, or the folder of `transforms.json` (or, for Blender's
            synthetic scenes, `transforms_train.json`).
        long_edge_px: reduce images to this longer edge, in pixels; None keeps them.
        skip_missing: leave out frames without an image file, as some published data
            sets need, and list them in `PosedImages.missing`.

    Raises:
        InputError: naming the file and the field that cannot be used.
    """
    source = find_transforms(Path(path))
    table, frames = read_table(source)
    image_paths, missing = _find_images(source, frames, skip_missing)
    used, paths = {i: frames[i] for i in image_paths}, list(image_paths.values())
    poses = read_frames(source, used)
    first = files.read_image(paths[0])
    cameras = read_cameras(source, table, used, image_shape=first.shape)
    images, reduced = load_images(paths, cameras, source, long_edge_px=long_edge_px)
    masks = load_masks(
        [
            None
            if (name := frame.get("mask_path")) is None
            else named_path(source, f"frames[{i}].mask_path", name)
            for i, frame in used.items()
        ],
        cameras,
        reduced,
    )
    names = tuple(str(frame["file_path"]) for frame in used.values())
    return PosedImages(
        images=images,
        camera_to_world=poses,
        camera=reduced[0],
        names=names,
        missing=tuple(missing),
        cameras=differing(reduced),
        points=_read_points(source, table, cameras, poses=poses),
        unit=str(table.get("units", "unknown")),
        masks=masks,
    )


def _find_images(
    source: Path, frames: Sequence[Mapping[str, Any]], skip_missing: bool
) -> tuple[dict[int, Path], list[str]]:
    """Return image files by their frames, and the names of those that are missing."""
    image_paths: dict[int, Path] = {}
    missing: list[str] = []
    for i, frame in enumerate(frames):
        image = _find_image(source, i, frame)
        if image is None:
            missing.append(frame["file_path"])
        else:
            image_paths[i] = image
    if missing and (not skip_missing or not image_paths):
        raise InputError(
            f"{source}: {len(missing)} of {len(frames)} frames have no image, first "
            f"{missing[0]!r}; restore the files or leave these frames out "
            "(--skip-missing, or skip_missing=True)"
        )
    return image_paths, missing


def named_path(source: Path, field: str, name: Any) -> Path:
    """Return the path of a file that a JSON file names, from the folder of this.

    Raises:
        InputError: with `field`: it is no name.
    """
    if not isinstance(name, str) or not name:
        raise InputError(f"{source}: {field}: {name!r}; needs a path")
    return source.parent / name.replace("\\", "/")


def _read_points(
    source: Path,
    table: Mapping[str, Any],
    cameras: Sequence[Camera],
    poses: np.ndarray,
) -> np.ndarray | None:
    """Read our own sparse points or nerfstudio's; None without."""
    key = "ply_file_path" if table.get("points_file") is None else "points_file"
    name = table.get(key)
    if name is None:
        return None
    where = named_path(source, key, name)
    if key == "points_file":
        points = _own_points(source, where)
    else:
        points = _turned_points(
            source, table, read_points(where), cameras=cameras, poses=poses
        )
    if not len(points):
        return None
    require_near(where, points)
    return points


def _turned_points(
    source: Path,
    table: Mapping[str, Any],
    points: np.ndarray,
    cameras: Sequence[Camera],
    poses: np.ndarray,
) -> np.ndarray:
    """Bring nerfstudio's points into the frame of the poses.

    Its versions differ in whether they turned the points as they turned the poses, by
    `applied_transform`. The points are taken of which the images show more, and of a
    tie those of the file, which today's version has turned.
    """
    transform = table.get("applied_transform")
    if transform is None:
        return points
    try:
        matrix = np.array(transform, np.float64)[:3]
    except (TypeError, ValueError, IndexError):
        matrix = np.zeros(0)
    if matrix.shape != (3, 4) or not np.abs(matrix).max() < np.finfo(np.float32).max:
        raise InputError(
            f"{source}: applied_transform: {transform!r}; needs 3 x 4 numbers"
        )
    with np.errstate(all="ignore"):
        candidates = [points, points @ matrix[:, :3].T + matrix[:, 3]]
        counts = [points_shown(cameras, poses, each).sum() for each in candidates]
    return candidates[int(counts[1] > counts[0])]


def _own_points(source: Path, where: Path) -> np.ndarray:
    points = files.read_safetensors(where)[0].get("points")
    if points is None or points.ndim != 2 or points.shape[1] != 3:
        shape = None if points is None else points.shape
        raise InputError(
            f"{where}: tensor 'points' has shape {shape}; needs (n, 3) numbers; remove "
            f"points_file from {source} to go without"
        )
    if not np.isfinite(points).all():
        raise InputError(f"{where}: tensor 'points' holds NaN or infinity")
    return points.astype(np.float64)


def begin_posed(folder: str | Path) -> Path:
    """Make a folder and its `images` ready for posed images.

    An earlier `transforms.json` is removed: its poses are not those of the images that
    replace its own.

    Returns:
        Path of `transforms.json`, to be written last.
    """
    root = files.make_folder(folder)
    path = root / FILE_NAMES[0]
    files.check_writable(path)
    path.unlink(missing_ok=True)
    files.make_folder(root / "images")
    return path


def write_poses(
    path: Path,
    names: Sequence[str],
    camera: Camera | Sequence[Camera],
    camera_to_world: np.ndarray,
    extra: Mapping[str, Any] | None = None,
    times_s: Sequence[float] | None = None,
    masks: Mapping[str, str] | None = None,
) -> None:
    """Write a `transforms.json` for images that exist.

    Args:
        path: of the file.
        names: of the images, relative to its folder.
        camera: shared intrinsics, or those of each image.
        camera_to_world: (n, 4, 4), OpenCV axes.
        extra: more keys for the top level.
        times_s: of the images, seconds: `time_s`, which recorded drives have.
        masks: paths of masks, relative to the folder, by the names of the images.
    """
    cameras = [camera] * len(names) if isinstance(camera, Camera) else list(camera)
    has_one = len(set(cameras)) == 1
    table: dict[str, Any] = {}
    table |= intrinsics_table(cameras[0]) if has_one else {}
    table |= extra or {}
    matrices = opencv_to_opengl(camera_to_world)
    table["frames"] = [
        {
            "file_path": name,
            **({} if has_one else intrinsics_table(own)),
            "transform_matrix": matrix.tolist(),
        }
        for name, own, matrix in zip(names, cameras, matrices, strict=True)
    ]
    for i, frame in enumerate(table["frames"]):
        if masks is not None and names[i] in masks:
            frame["mask_path"] = masks[names[i]]
        if times_s is not None:
            frame["time_s"] = times_s[i]
    files.write_json(path, table)


def read_table(source: Path) -> tuple[dict[str, Any], list[Any]]:
    """Return the content of a `transforms.json`, and its frames.

    Raises:
        InputError: it is not JSON, or has no frames.
    """
    table = files.read_json(source)
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{source}: frames: missing or empty; needs a list of frames")
    return table, frames


def find_transforms(path: Path) -> Path:
    """Return the JSON file that a path names: itself, or the one in the folder."""
    with files.reported(path):
        if not path.is_dir():
            return path
        json_path = _json_in(path)
    if json_path is None:
        raise InputError(f"{path}: has neither {FILE_NAMES[0]} nor {FILE_NAMES[1]}")
    return json_path


def _find_image(source: Path, index: int, frame: Any) -> Path | None:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    base = str(named_path(source, f"frames[{index}].file_path", name))
    for suffix in ("", *files.IMAGE_SUFFIXES):
        candidate = Path(base + suffix)
        if os.path.isfile(candidate):
            return candidate
    return None


def read_frames(source: Path, frames: Mapping[int, Any]) -> np.ndarray:
    """Read the poses of frames.

    Args:
        source: the JSON file, for messages.
        frames: by their index in the file, each with `transform_matrix`, OpenGL axes,
            (4, 4) or (3, 4). A rotation that is rounded to three decimals is replaced
            by the nearest one.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes, float64.

    Raises:
        InputError: a matrix is missing or not a rigid pose, or the poses are far from
            the origin.
    """
    poses = np.stack([_read_pose(source, i, frame) for i, frame in frames.items()])
    require_near(source, poses[:, :3, 3])
    return opengl_to_opencv(poses)


def _read_pose(source: Path, index: int, frame: Any) -> np.ndarray:
    if not isinstance(frame, dict):
        raise InputError(f"{source}: frames[{index}]: {frame!r}; needs an object")
    where = f"{source}: frames[{index}].transform_matrix"
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: not a matrix of numbers; needs 4 x 4") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: shape {matrix.shape}; needs 4 x 4 numbers")
    return nearest_rigid(matrix, where)
