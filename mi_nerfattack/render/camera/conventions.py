"""Conversions of cameras and poses between conventions: the only module that does it.

================================  =======  ====  =======  ==========================
camera's frame                    x        y     looks    pose
================================  =======  ====  =======  ==========================
ours, OpenCV                      right    down  along z  camera to world
COLMAP                            right    down  along z  world to camera, as
                                                          quaternion and translation
OpenGL: `transforms.json` of      right    up    against  camera to world
nerfstudio, Instant-NGP, Blender                 z
Mitsuba's sensors                 left     up    along z  camera to world
================================  =======  ====  =======  ==========================

The world stays as it is. Pixels count from the top-left corner of the image in all of
them: the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera

if TYPE_CHECKING:
    import mitsuba as mi

COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""Parameters of COLMAP's camera models, in its order; pixels, distortion unitless."""

_SQUARE = 1e-5  # relative difference of focal lengths that counts as none


def _flip_columns(matrix: ArrayLike, signs: tuple[int, int, int]) -> np.ndarray:
    return np.asarray(matrix, np.float64) * np.array([*signs, 1.0])


def opengl_to_opencv(matrix: ArrayLike) -> np.ndarray:
    """Convert camera-to-world (..., 4, 4) from OpenGL's to OpenCV's camera axes."""
    return _flip_columns(matrix, (1, -1, -1))


def opencv_to_opengl(matrix: ArrayLike) -> np.ndarray:
    """Convert camera-to-world (..., 4, 4) from OpenCV's to OpenGL's camera axes."""
    return _flip_columns(matrix, (1, -1, -1))


def opencv_to_mitsuba(matrix: ArrayLike) -> np.ndarray:
    """Convert camera-to-world (..., 4, 4) from OpenCV's to Mitsuba's camera axes."""
    return _flip_columns(matrix, (-1, -1, 1))


def mitsuba_to_opencv(matrix: ArrayLike) -> np.ndarray:
    """Convert camera-to-world (..., 4, 4) from Mitsuba's to OpenCV's camera axes."""
    return _flip_columns(matrix, (-1, -1, 1))


def colmap_to_opencv(quaternion: ArrayLike, translation: ArrayLike) -> np.ndarray:
    """Convert poses of COLMAP's `images.txt` to camera-to-world matrices.

    Args:
        quaternion: (..., 4), world to camera, in the order w, x, y, z; of any length
            but zero.
        translation: (..., 3), world to camera, in the world's unit.

    Returns:
        camera_to_world: (..., 4, 4), OpenCV axes, float64.

    Raises:
        InputError: a quaternion is zero, a value is not finite, or a translation is
            beyond single precision.
    """
    q = np.asarray(quaternion, np.float64)
    t = np.asarray(translation, np.float64)
    largest = np.abs(q).max(-1, keepdims=True)  # whose square may be too large
    if not (np.isfinite(largest) & (largest > 0)).all():
        raise InputError(f"quaternion: {q.tolist()}; must be finite and not zero")
    if not (np.abs(t) < np.finfo(np.float32).max).all():
        raise InputError(f"translation: {t.tolist()}; must be finite, below 3.4e38")
    # World to camera is R x + t, so camera to world is R^T x - R^T t
    unit = (q / largest).reshape(-1, 4)
    flat = Rotation.from_quat(unit, scalar_first=True).as_matrix()
    to_world = np.swapaxes(flat.reshape(*q.shape[:-1], 3, 3), -1, -2)
    matrix = np.zeros((*q.shape[:-1], 4, 4))
    matrix[..., :3, :3] = to_world
    matrix[..., :3, 3] = -(to_world @ t[..., None])[..., 0]
    matrix[..., 3, 3] = 1
    return matrix


def from_colmap(
    model: str, width: int, height: int, parameters: Sequence[float]
) -> Camera:
    """Make the camera that a line of COLMAP's `cameras.txt` describes.

    Args:
        model: one of `COLMAP_MODELS`.
        width: image width in pixels.
        height: image height in pixels.
        parameters: in COLMAP's order.

    Raises:
        InputError: another model, another number of parameters, or impossible values.
    """
    names = _colmap_names(model)
    if len(parameters) != len(names):
        raise InputError(
            f"camera model {model}: {len(parameters)} parameters; expected "
            f"{len(names)} ({', '.join(names)})"
        )
    values = dict(zip(names, map(float, parameters), strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    return Camera(width, height, **values, is_fisheye=model == "OPENCV_FISHEYE")


def to_colmap(camera: Camera) -> tuple[str, dict[str, float]]:
    """Return the model of COLMAP that a camera has, and its size and parameters."""
    model = "OPENCV_FISHEYE" if camera.is_fisheye else "OPENCV"
    names = ("width", "height", *COLMAP_MODELS[model])
    return model, {name: getattr(camera, name) for name in names}


def _colmap_names(model: str) -> tuple[str, ...]:
    if model not in COLMAP_MODELS:
        raise InputError(f"camera model {model!r}; allowed: {', '.join(COLMAP_MODELS)}")
    return COLMAP_MODELS[model]


def mitsuba_sensor_dict(
    camera: Camera,
    camera_to_world: np.ndarray,
    spp: int,
    film: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Describe the camera as a Mitsuba sensor.

    Without distortion and with square pixels it is a stock `perspective`, otherwise
    our `opencv_camera`.

    Args:
        camera: intrinsics.
        camera_to_world: (4, 4), OpenCV axes, metres.
        spp: samples per pixel of the `multijitter` sampler.
        film: more or other properties of the `hdrfilm`, whose defaults here are
            32-bit RGB and a box filter.
    """
    import mitsuba as mi

    square = abs(camera.fx / camera.fy - 1) <= _SQUARE
    stock = square and not camera.is_distorted
    return {
        **(_perspective(camera) if stock else _opencv_camera(camera)),
        "near_clip": 1e-2,
        "far_clip": 1e4,
        "to_world": mi.ScalarTransform4f(opencv_to_mitsuba(camera_to_world)),
        "sampler": {"type": "multijitter", "sample_count": spp},
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
            **(film or {}),
        },
    }


def _perspective(camera: Camera) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(0.5 * camera.width / camera.fx)),
        "fov_axis": "x",
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
    }


def _opencv_camera(camera: Camera) -> dict[str, Any]:
    _, values = to_colmap(camera)
    del values["width"], values["height"]
    lens = {name: float(value) for name, value in values.items()}
    return {"type": "opencv_camera", "fisheye": camera.is_fisheye, **lens}


def from_mitsuba(sensor: mi.Sensor) -> tuple[Camera, np.ndarray]:
    """Read the camera and the pose of a Mitsuba sensor.

    Args:
        sensor: a `perspective`, `thinlens` (its aperture is left out) or
            `opencv_camera`; the camera is that of the full film.

    Returns:
        intrinsics and camera_to_world (4, 4), OpenCV axes, float64.

    Raises:
        InputError: the sensor is of another kind.
    """
    import mitsuba as mi

    params = mi.traverse(sensor)
    width, height = map(int, sensor.film().size())
    if "fx" in params:
        # Our `opencv_camera`: its parameters are named as in COLMAP
        model = "OPENCV_FISHEYE" if "k3" in params else "OPENCV"
        numbers = [_number(params[name]) for name in COLMAP_MODELS[model]]
        camera = from_colmap(model, width, height, parameters=numbers)
    elif "x_fov" in params:
        # A stock camera: a horizontal angle, and offsets in widths and heights
        focal = 0.5 * width / math.tan(math.radians(0.5 * _number(params["x_fov"])))
        shift = [
            _number(params[key]) if key in params else 0.0
            for key in ("principal_point_offset_x", "principal_point_offset_y")
        ]
        cx, cy = (0.5 - shift[0]) * width, (0.5 - shift[1]) * height
        camera = Camera(width, height, fx=focal, fy=focal, cx=cx, cy=cy)
    else:
        raise InputError(
            f"sensor {sensor.id()!r}: {sensor.class_name()}; only perspective, "
            "thinlens and opencv_camera are pinhole cameras"
        )
    matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    return camera, mitsuba_to_opencv(matrix)


def _number(value: Any) -> float:
    return float(np.array(value, np.float64).reshape(-1)[0])
