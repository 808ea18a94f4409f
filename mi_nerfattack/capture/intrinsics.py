"""The camera described by a `transforms.json` file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import Camera
from mi_nerfattack.render.conventions import COLMAP_MODELS

_NUMBERS = "w h fl_x fl_y cx cy camera_angle_x camera_angle_y k1 k2 p1 p2 k3 k4".split()


def read_camera(
    source: Path,
    table: Mapping[str, Any],
    frames: Sequence[Mapping[str, Any]],
    image_shape: tuple[int, ...],
) -> Camera:
    """Build the one camera of all frames.

    Args:
        source: the JSON file, for messages.
        table: its content; a key in every frame takes precedence over the top level.
        frames: the frames in use.
        image_shape: (height, width, ...) of the first image.

    Raises:
        InputError: unknown lens model, differing or missing intrinsics, or a size that
            is not the image's.
    """
    model = table.get("camera_model", "OPENCV")
    if model not in COLMAP_MODELS or table.get("is_fisheye"):
        raise InputError(
            f"{source}: camera_model: {model!r}, is_fisheye: "
            f"{table.get('is_fisheye', False)!r}; only {', '.join(COLMAP_MODELS)} "
            "can be read"
        )
    values = {key: _shared_number(source, key, table, frames) for key in _NUMBERS}
    for key in ("k3", "k4"):
        if values[key]:
            raise InputError(
                f"{source}: {key}: {values[key]}; only k1, k2, p1, p2 are supported; "
                "calibrate with four coefficients or undistort the images"
            )
    width, height = _size(source, values, image_shape)
    fl_x, fl_y = _focal_lengths(source, values, width, height)
    try:
        return Camera(
            width,
            height,
            fl_x,
            fl_y,
            _or(values["cx"], 0.5 * width),
            _or(values["cy"], 0.5 * height),
            *(_or(values[key], 0.0) for key in ("k1", "k2", "p1", "p2")),
        )
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


def _shared_number(
    source: Path,
    key: str,
    table: Mapping[str, Any],
    frames: Sequence[Mapping[str, Any]],
) -> float | None:
    values = {_number(source, key, f.get(key, table.get(key))) for f in frames}
    if len(values) > 1:
        raise InputError(
            f"{source}: {key}: differs between frames ({sorted(map(str, values))[:2]}, "
            "...); all frames must share one camera"
        )
    return values.pop()


def _number(source: Path, key: str, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{source}: {key}: {value!r}; must be a number")
    if not math.isfinite(value):
        raise InputError(f"{source}: {key}: {value}; must be finite")
    return float(value)


def _size(
    source: Path, values: Mapping[str, float | None], shape: tuple[int, ...]
) -> tuple[int, int]:
    size = _or(values["w"], shape[1]), _or(values["h"], shape[0])
    if size != (shape[1], shape[0]):
        raise InputError(
            f"{source}: w, h: {size[0]:g} x {size[1]:g}, but the first image has "
            f"{shape[1]} x {shape[0]} px; the intrinsics must be those of the images"
        )
    return shape[1], shape[0]


def _focal_lengths(
    source: Path, values: Mapping[str, float | None], width: int, height: int
) -> tuple[float, float]:
    def focal(axis: str, size: int) -> float | None:
        angle = values[f"camera_angle_{axis}"]
        if values[f"fl_{axis}"] is not None or angle is None:
            return values[f"fl_{axis}"]
        if not 0 < angle < math.pi:
            raise InputError(
                f"{source}: camera_angle_{axis}: {angle}; must be in (0, pi) radians"
            )
        return 0.5 * size / math.tan(0.5 * angle)

    fl_x, fl_y = focal("x", width), focal("y", height)
    if fl_x is None and fl_y is None:
        raise InputError(
            f"{source}: fl_x: missing; give fl_x (pixels) or camera_angle_x (radians)"
        )
    fl_x, fl_y = (fl_y if fl_x is None else fl_x), (fl_x if fl_y is None else fl_y)
    if fl_x is None or fl_y is None or min(fl_x, fl_y) <= 0:
        raise InputError(f"{source}: fl_x, fl_y: {fl_x}, {fl_y}; must be positive")
    return fl_x, fl_y
