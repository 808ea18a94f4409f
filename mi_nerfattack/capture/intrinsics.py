"""The cameras described by a `transforms.json` file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.conventions import COLMAP_MODELS
from mi_nerfattack.render.camera.intrinsics import Camera

_NUMBERS = "w h fl_x fl_y cx cy camera_angle_x camera_angle_y k1 k2 p1 p2 k3 k4".split()
_KEYS = (*_NUMBERS, "camera_model", "is_fisheye", "distortion_params")
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")  # nerfstudio's order, distortion_params


def read_cameras(
    source: Path,
    table: Mapping[str, Any],
    frames: Mapping[int, Mapping[str, Any]],
    image_shape: tuple[int, ...],
) -> tuple[Camera, ...]:
    """Build the cameras of all frames.

    Reads the keys `_KEYS`, k3 and k4 of a fisheye alone.

    Args:
        source: the JSON file, for messages.
        table: its content; a key in a frame takes precedence over the top level.
        frames: those in use, in order, by their index in the file.
        image_shape: (height, width, ...) of the first image, for frames without size.

    Returns:
        one camera per frame, equal where their numbers are.

    Raises:
        InputError: unknown lens model, missing or impossible intrinsics, or those of
            the first frame are for another size than its image.
    """
    known: dict[tuple[float | None, ...], Camera] = {}
    cameras = []
    for index, frame in frames.items():
        is_own = any(key in frame for key in _KEYS)
        where = f"{source}: frames[{index}]" if is_own else str(source)
        merged = {**table, **frame}
        is_fisheye = _is_fisheye(where, merged)
        values = _numbers(where, merged, is_fisheye)
        if not cameras:
            _check_first_size(where, values, image_shape)
        key = (is_fisheye, *values.values())
        if key not in known:
            known[key] = _camera(where, values, image_shape, is_fisheye=is_fisheye)
        cameras.append(known[key])
    return tuple(cameras)


def intrinsics_table(camera: Camera) -> dict[str, Any]:
    """Return the keys of a `transforms.json`, or of one of its frames."""
    model = "OPENCV_FISHEYE" if camera.is_fisheye else "OPENCV"
    return {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        **{name: getattr(camera, name) for name in COLMAP_MODELS[model][4:]},
        "camera_angle_x": 2 * math.atan(0.5 * camera.width / camera.fx),
    }


def _is_fisheye(where: str, merged: Mapping[str, Any]) -> bool:
    model = merged.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in COLMAP_MODELS:
        raise InputError(
            f"{where}: camera_model: {model!r}; only {', '.join(COLMAP_MODELS)} "
            "can be read; undistort the images first"
        )
    return model == "OPENCV_FISHEYE" or bool(merged.get("is_fisheye"))


def _numbers(
    where: str, merged: Mapping[str, Any], is_fisheye: bool
) -> dict[str, float | None]:
    values = {key: _number(where, key, merged.get(key)) for key in _NUMBERS}
    lens = merged.get("distortion_params")
    if lens is not None:
        if not isinstance(lens, list) or len(lens) != len(_LENS):
            raise InputError(
                f"{where}: distortion_params: {lens!r}; must be six numbers, "
                f"{', '.join(_LENS)}"
            )
        for key, value in zip(_LENS, lens, strict=True):
            values[key] = _number(where, f"distortion_params, {key}", value)
    for key in ("k3", "k4", "k5", "k6"):
        if (value := merged.get(key) or values.get(key)) and not (
            is_fisheye and key in ("k3", "k4")
        ):
            raise InputError(
                f"{where}: {key}: {value}; only k1, k2, p1, p2 are supported, and of "
                "a fisheye k1 to k4; calibrate with four coefficients or undistort "
                "the images"
            )
    return values


def _camera(
    where: str,
    values: Mapping[str, float | None],
    image_shape: tuple[int, ...],
    is_fisheye: bool,
) -> Camera:
    width = _size(where, "w", values["w"], default=image_shape[1])
    height = _size(where, "h", values["h"], default=image_shape[0])
    fl_x, fl_y = _focal_lengths(where, values, width, height=height)
    try:
        return Camera(
            width,
            height,
            fl_x,
            fl_y,
            _or(values["cx"], 0.5 * width),
            _or(values["cy"], 0.5 * height),
            *(_or(values[key], 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4")),
            is_fisheye=is_fisheye,
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _check_first_size(
    where: str, values: Mapping[str, float | None], shape: tuple[int, ...]
) -> None:
    size = _or(values["w"], shape[1]), _or(values["h"], shape[0])
    if size != (shape[1], shape[0]):
        raise InputError(
            f"{where}: w, h: {size[0]:g} x {size[1]:g}, but the first image has "
            f"{shape[1]} x {shape[0]} px; give the images that were calibrated, or "
            "scale the intrinsics"
        )


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


def _size(where: str, key: str, value: float | None, default: int) -> int:
    if value is None:
        return default
    if value < 1 or value != int(value):
        raise InputError(f"{where}: {key}: {value:g}; must be a whole number of px")
    return int(value)


def _number(where: str, key: str, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key}: {value!r}; must be a number")
    if not math.isfinite(value):
        raise InputError(f"{where}: {key}: {value}; must be finite")
    return float(value)


def _focal_lengths(
    where: str, values: Mapping[str, float | None], width: int, height: int
) -> tuple[float, float]:
    def focal(axis: str, size: int) -> float | None:
        angle = values[f"camera_angle_{axis}"]
        if values[f"fl_{axis}"] is not None or angle is None:
            return values[f"fl_{axis}"]
        if not 0 < angle < math.pi:
            raise InputError(
                f"{where}: camera_angle_{axis}: {angle}; must be in (0, pi) radians"
            )
        return 0.5 * size / math.tan(0.5 * angle)

    fl_x, fl_y = focal("x", width), focal("y", height)
    if fl_x is None and fl_y is None:
        raise InputError(
            f"{where}: fl_x: missing; give fl_x (pixels) or camera_angle_x (radians)"
        )
    fl_x, fl_y = (fl_y if fl_x is None else fl_x), (fl_x if fl_y is None else fl_y)
    if fl_x is None or fl_y is None or min(fl_x, fl_y) <= 0:
        raise InputError(f"{where}: fl_x, fl_y: {fl_x}, {fl_y}; must be positive")
    return fl_x, fl_y
