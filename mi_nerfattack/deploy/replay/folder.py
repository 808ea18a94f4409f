"""Recorded drives as folders of images."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mi_nerfattack.capture.pose_files import PoseTable, read_poses
from mi_nerfattack.capture.transforms import FILE_NAMES
from mi_nerfattack.deploy.replay.recording import (
    AbstractRecording,
    Track,
    checked_image,
    no_depth,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount

_POSE_FILES = (*FILE_NAMES, "poses.csv", "poses.toml")


class FolderRecording(AbstractRecording):
    """A folder with images and one of `transforms.json`, `poses.csv`, `poses.toml`.

    Args:
        folder: as `capture` writes it, or with a pose file (see `pose_files`) whose
            rows name the images.
        camera: intrinsics, for pose files without.
        mount: of the camera, for poses of the vehicle.
        period: seconds between frames, for pose files without times.
    """

    def __init__(
        self, folder: Path, camera: Camera | None, mount: CameraMount, period: float
    ) -> None:
        source = _pose_file(folder)
        table = read_poses(source, mount)
        self._images = _find_images(table)
        first = files.read_image(self._images[0])
        if source.suffix == ".json":
            table = read_poses(source, mount, first.shape)
        self.camera = required_camera(source, table.camera, camera)
        checked_image(str(self._images[0]), first, self.camera)
        count = len(self._images)
        times = period * np.arange(count) if table.times is None else table.times
        self.track = Track(str(source), times, table.camera_to_world)
        self._depth = _read_depth(table, self.camera)

    def image(self, index: int) -> np.ndarray:
        """Read one image file."""
        path = self._images[index]
        return checked_image(str(path), files.read_image(path), self.camera)

    def depth(self, index: int) -> np.ndarray:
        """Return the depth of one frame."""
        return (
            self._depth[index].copy()
            if self._depth is not None
            else no_depth(self.camera)
        )


def required_camera(source: Path, own: Camera | None, default: Camera | None) -> Camera:
    """Return a recording's own camera, or the default one.

    Raises:
        InputError: there is none.
    """
    camera = default if own is None else own
    if camera is None:
        raise InputError(f"{source}: no intrinsics; add a camera, or give one")
    return camera


def _pose_file(folder: Path) -> Path:
    with files.reported(folder):
        paths = [folder / name for name in _POSE_FILES if (folder / name).is_file()]
    if not paths:
        raise InputError(
            f"{folder}: no poses; looked for {', '.join(_POSE_FILES)}; estimate them "
            f"with 'mi-nerfattack capture photographs {folder} -o FOLDER'"
        )
    return paths[0]


def _find_images(table: PoseTable) -> list[Path]:
    if not table.names:
        raise InputError(f"{table.where}: its rows name no images; add a column 'file'")
    folder, paths = table.where.parent, []
    for index, name in enumerate(table.names):
        base = str(folder / name.replace("\\", "/"))
        candidates = [Path(base + end) for end in ("", *files.IMAGE_SUFFIXES)]
        path = next((item for item in candidates if os.path.isfile(item)), None)
        if path is None:
            raise InputError(
                f"{table.where}: row {index}: {name!r} is not there; restore the "
                "image or take the row out"
            )
        paths.append(path)
    return paths


def _read_depth(table: PoseTable, camera: Camera) -> np.ndarray | None:
    """Read (n, height, width), float32, metres along the ray; None without depth."""
    if table.depth_file is None:
        return None
    if not isinstance(table.depth_file, str) or not table.depth_file:
        raise InputError(
            f"{table.where}: depth_file: {table.depth_file!r}; needs a path"
        )
    path = table.where.parent / table.depth_file
    depth = files.read_safetensors(path)[0].get("depth")
    shape = len(table.camera_to_world), camera.height, camera.width
    if depth is None or depth.shape != shape:
        stored_shape = None if depth is None else depth.shape
        raise InputError(
            f"{path}: tensor 'depth' has shape {stored_shape}; needs {shape}"
        )
    if (depth <= 0).any():
        raise InputError(
            f"{path}: tensor 'depth' holds a depth of 0 or less; write infinity where "
            "there is nothing"
        )
    return np.where(np.isnan(depth), np.inf, depth).astype(np.float32)
