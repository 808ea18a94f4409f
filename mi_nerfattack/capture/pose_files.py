"""Pose files of recordings: CSV, TOML and `transforms.json`.

A row has ``time_s``, for folders ``file``, and a pose in one of two forms:

- ``x_m, y_m, heading_rad``: the vehicle's; the camera sits on it as mounted;
- ``x_m, y_m, z_m, qw, qx, qy, qz``: the camera's, to the world, OpenCV axes.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.capture.intrinsics import read_cameras
from mi_nerfattack.capture.transforms import read_frames, read_table
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix

SUFFIXES = (".csv", ".toml", ".json")
VEHICLE_KEYS = ("x_m", "y_m", "heading_rad")
CAMERA_KEYS = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
_UNIT = 1e-2  # how far a quaternion's length may be from 1


@dataclass(frozen=True, eq=False)
class PoseTable:
    """What a pose file says.

    Args:
        where: the file.
        camera_to_world: (n, 4, 4), OpenCV axes, metres.
        times: (n,), seconds; None where the file has none.
        names: of the images, relative to the file; empty where it has none.
        camera: intrinsics; None where the file has none.
        depth_file: as in `transforms.json`; None where it names none.
    """

    where: Path
    camera_to_world: np.ndarray
    times: np.ndarray | None = None
    names: tuple[str, ...] = ()
    camera: Camera | None = None
    depth_file: str | None = None


def read_poses(
    path: Path, mount: CameraMount, image_shape: tuple[int, ...] | None = None
) -> PoseTable:
    """Read a pose file.

    Args:
        path: .csv, .toml or .json.
        mount: of the camera, for poses of the vehicle.
        image_shape: (height, width, ...) of the frames, for intrinsics without size;
            None leaves those of a JSON file unread.

    Raises:
        InputError: naming the file, the row and the key that cannot be used.
    """
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _read_json(path, image_shape)
    if suffix == ".csv":
        return _from_rows(path, _csv_rows(path), mount, camera=None)
    if suffix == ".toml":
        table = files.read_toml(path)
        rows = table.get("frames")
        if not isinstance(rows, list) or not all(isinstance(r, dict) for r in rows):
            raise InputError(f"{path}: frames: needs a [[frames]] table per frame")
        return _from_rows(path, rows, mount, camera=_camera(path, table.get("camera")))
    raise InputError(f"{path}: not a pose file; use {', '.join(SUFFIXES)}")


def _read_json(path: Path, image_shape: tuple[int, ...] | None) -> PoseTable:
    table, frames = read_table(path)
    if table.get("units") == "arbitrary":
        raise InputError(
            f"{path}: units: 'arbitrary'; a drive is replayed in metres: tell "
            "'mi-nerfattack capture photographs' the scale by --marker-m, --distance "
            "or --metres-per-unit"
        )
    numbered = dict(enumerate(frames))
    poses = read_frames(path, numbered)
    camera = None
    if image_shape is not None:
        cameras = set(read_cameras(path, table, numbered, image_shape=image_shape))
        if len(cameras) > 1:
            raise InputError(
                f"{path}: {len(cameras)} cameras; a drive is recorded by one"
            )
        (camera,) = cameras
    return PoseTable(
        where=path,
        camera_to_world=poses,
        times=_times(path, frames),
        names=_names(path, frames, "file_path"),
        camera=camera,
        depth_file=table.get("depth_file"),
    )


def _csv_rows(path: Path) -> list[dict[str, Any]]:
    reader = csv.reader(io.StringIO(files.read_text(path)))
    try:
        lines = [line for line in reader if line]
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num}: {error}") from error
    if not lines:
        raise InputError(f"{path}: empty; needs a line of column names")
    header = [name.strip() for name in lines[0]]
    if twice := sorted({name for name in header if header.count(name) > 1}):
        raise InputError(f"{path}: {', '.join(twice)}: named twice; take one out")
    for number, line in enumerate(lines[1:]):
        if len(line) != len(header):
            raise InputError(
                f"{path}: row {number} has {len(line)} values; the first line names "
                f"{len(header)}"
            )
    return [dict(zip(header, line, strict=True)) for line in lines[1:]]


def _from_rows(
    path: Path,
    rows: Sequence[Mapping[str, Any]],
    mount: CameraMount,
    camera: Camera | None,
) -> PoseTable:
    if not rows:
        raise InputError(f"{path}: no frames; needs a row for each")
    known = ("time_s", "file", *VEHICLE_KEYS, *CAMERA_KEYS)
    if unknown := sorted({key for row in rows for key in row} - set(known)):
        raise InputError(
            f"{path}: {', '.join(unknown)}: unknown; a frame has time_s, file and a "
            "pose: correct the name, or take it out"
        )
    poses = []
    for index, row in enumerate(rows):
        where = f"{path}: row {index}"
        if all(key in row for key in CAMERA_KEYS):
            values = [_number(where, key, row[key]) for key in CAMERA_KEYS]
            poses.append(pose_matrix(where, values[:3], values[3:]))
        elif all(key in row for key in VEHICLE_KEYS):
            state = [_number(where, key, row[key]) for key in VEHICLE_KEYS]
            poses.append(mount_matrix(np.array([state]), mount)[0])
        else:
            raise InputError(
                f"{where}: no pose; needs {', '.join(VEHICLE_KEYS)} of the vehicle or "
                f"{', '.join(CAMERA_KEYS)} of the camera"
            )
    require_near(path, np.stack(poses)[:, :3, 3])
    names = _names(path, rows, "file")
    return PoseTable(
        path, np.stack(poses), _times(path, rows), names=names, camera=camera
    )


def pose_matrix(
    where: str, position: Sequence[float], quaternion: Sequence[float]
) -> np.ndarray:
    """Return the pose (4, 4) of a position and a unit quaternion w, x, y, z.

    Raises:
        InputError: with `where`: a value that is not finite, or another length.
    """
    values = np.array([*position, *quaternion], np.float64)
    length = float(np.linalg.norm(values[3:]))
    if not (np.isfinite(values).all() and abs(length - 1) < _UNIT):
        raise InputError(
            f"{where}: position {list(position)}, quaternion {list(quaternion)}; "
            "must be finite, and the quaternion of length 1"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(values[3:], scalar_first=True).as_matrix()
    matrix[:3, 3] = values[:3]
    return matrix


def _times(path: Path, rows: Sequence[Mapping[str, Any]]) -> np.ndarray | None:
    times = [row.get("time_s") for row in rows]
    if all(value is None for value in times):
        return None
    values = [_number(f"{path}: row {i}", "time_s", v) for i, v in enumerate(times)]
    return np.array(values)


def _names(path: Path, rows: Sequence[Mapping[str, Any]], key: str) -> tuple[str, ...]:
    names = [row.get(key) for row in rows]
    if all(name is None for name in names):
        return ()
    for index, name in enumerate(names):
        if not isinstance(name, str) or not name:
            raise InputError(f"{path}: row {index}: {key}: {name!r}; needs a path")
    return tuple(str(name).strip() for name in names)


def _number(where: str, key: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{where}: {key}: {value!r}; must be a finite number")
    return number


def _camera(path: Path, table: Any) -> Camera | None:
    if table is None:
        return None
    where = f"{path}: camera"
    if not isinstance(table, dict):
        raise InputError(f"{where}: needs a [camera] table")
    known = [field.name for field in fields(Camera)]
    wrong = set(table) - set(known) | set(known[:6]) - set(table)
    if wrong:
        raise InputError(
            f"{where}: {', '.join(sorted(wrong))}; needs {', '.join(known[:6])}, and "
            f"may have {', '.join(known[6:])}"
        )
    is_fisheye = table.get("is_fisheye", False)
    if not isinstance(is_fisheye, bool):
        raise InputError(f"{where}: is_fisheye: {is_fisheye!r}; must be true or false")
    numbers = {key: value for key, value in table.items() if key != "is_fisheye"}
    values = {key: _number(where, key, value) for key, value in numbers.items()}
    size = [values.pop(key) for key in ("width", "height")]
    if any(value != int(value) for value in size):
        raise InputError(f"{where}: width, height: {size}; must be whole numbers of px")
    try:
        return Camera(*map(int, size), **values, is_fisheye=is_fisheye)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
