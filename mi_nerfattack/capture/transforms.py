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
from mi_nerfattack.capture.intrinsics import intrinsics_table, read_cameras
from mi_nerfattack.capture.masks import load_masks
from mi_nerfattack.capture.posed_images import (
    PosedImages,
    differing,
    held_out,
    load_images,
    resize_area,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.conventions import opencv_to_opengl, opengl_to_opencv
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.pose import check_rigid

FILE_NAMES = ("transforms.json", "transforms_train.json")
"""What the JSON file of a folder may be called; the first that is there is read."""

__all__ = [
    "FILE_NAMES",
    "PosedImages",
    "check_rigid",
    "find_transforms",
    "held_out",
    "read_images",
    "read_pose",
    "read_table",
    "read_transforms",
    "resize_area",
    "write_poses",
]


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
    if folder.is_dir() and not _json_in(folder):
        model = find_model(folder)
        if model is None:
            raise InputError(_nothing_found(folder))
        return read_colmap(folder, long_edge_px, skip_missing)
    return read_transforms(folder, long_edge_px, skip_missing)


def _nothing_found(folder: Path) -> str:
    photographs = [
        item
        for sub in (folder, folder / "images")
        for item in (sub.iterdir() if sub.is_dir() else ())
        if item.suffix.lower() in files.IMAGE_SUFFIXES
    ]
    advice = (
        f"it holds {len(photographs)} photographs: estimate their poses with "
        f"'mi-nerfattack capture {photographs[0].parent} -o FOLDER'"
        if photographs
        else "give the folder that holds one of them"
    )
    return (
        f"{folder}: no posed images; looked for {' or '.join(FILE_NAMES)}, and for a "
        f"COLMAP model (cameras and images, .bin or .txt) in {', '.join(MODEL_FOLDERS)}"
        f"; {advice}"
    )


def _json_in(folder: Path) -> Path | None:
    found = [folder / name for name in FILE_NAMES if (folder / name).is_file()]
    return found[0] if found else None


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
    found: list[tuple[int, Path]] = []
    missing: list[str] = []
    for i, frame in enumerate(frames):
        image = _find_image(source, i, frame)
        if image is None:
            missing.append(frame["file_path"])
        else:
            found.append((i, image))
    if missing and (not skip_missing or not found):
        raise InputError(
            f"{source}: {len(missing)} of {len(frames)} frames have no image, first "
            f"{missing[0]!r}; restore the files or leave these frames out "
            "(--skip-missing, or skip_missing=True)"
        )
    poses = np.stack([read_pose(source, i, frames[i]) for i, _ in found])
    first = files.read_image(found[0][1])
    used = {i: frames[i] for i, _ in found}
    cameras = read_cameras(source, table, used, first.shape)
    paths = [image for _, image in found]
    images, reduced = load_images(paths, cameras, source, long_edge_px)
    masks = load_masks(
        [_mask_path(source, i, frame) for i, frame in used.items()], cameras, reduced
    )
    names = tuple(str(frame["file_path"]) for frame in used.values())
    return PosedImages(
        images,
        poses,
        reduced[0],
        names,
        tuple(missing),
        differing(reduced),
        _read_points(source, table),
        str(table.get("units", "unknown")),
        masks,
    )


def _mask_path(source: Path, index: int, frame: Mapping[str, Any]) -> Path | None:
    name = frame.get("mask_path")
    if name is None:
        return None
    if not isinstance(name, str) or not name:
        raise InputError(f"{source}: frames[{index}].mask_path: {name!r}; needs a path")
    return source.parent / name.replace("\\", "/")


def _read_points(source: Path, table: Mapping[str, Any]) -> np.ndarray | None:
    name = table.get("points_file")
    if name is None:
        return None
    if not isinstance(name, str) or not name:
        raise InputError(f"{source}: points_file: {name!r}; needs a path")
    where = source.parent / name
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
    path = root / "transforms.json"
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
    table: dict[str, Any] = {"camera_model": "OPENCV"}
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
    for frame in table["frames"]:
        if masks is not None and frame["file_path"] in masks:
            frame["mask_path"] = masks[frame["file_path"]]
    if times_s is not None:
        for frame, time_s in zip(table["frames"], times_s, strict=True):
            frame["time_s"] = time_s
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
    if not path.is_dir():
        return path
    found = _json_in(path)
    if found is None:
        raise InputError(f"{path}: has neither {FILE_NAMES[0]} nor {FILE_NAMES[1]}")
    return found


def _find_image(source: Path, index: int, frame: Any) -> Path | None:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str) or not name:
        raise InputError(f"{source}: frames[{index}].file_path: {name!r}; needs a path")
    base = str(source.parent / name.replace("\\", "/"))
    for suffix in ("", *files.IMAGE_SUFFIXES):
        candidate = Path(base + suffix)
        if os.path.isfile(candidate):
            return candidate
    return None


def read_pose(source: Path, index: int, frame: Mapping[str, Any]) -> np.ndarray:
    """Read the pose of one frame.

    Args:
        source: the JSON file, for messages.
        index: of the frame, for messages.
        frame: with `transform_matrix`, OpenGL axes, (4, 4) or (3, 4).

    Returns:
        camera_to_world: (4, 4), OpenCV axes, float64.

    Raises:
        InputError: the matrix is missing or not a rigid pose.
    """
    where = f"{source}: frames[{index}].transform_matrix"
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: not a matrix of numbers; needs 4 x 4") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: shape {matrix.shape}; needs 4 x 4 numbers")
    check_rigid(matrix, where)
    return opengl_to_opencv(matrix)
