"""Frames, units and images of CARLA, to ours and back; needs no CARLA.

==================  ============  ======================  ===========================
                    lengths       axes                    angles
==================  ============  ======================  ===========================
ours                metres        x forward, y left,      radians, counter-clockwise
                                  z up, right-handed      from above
CARLA's client API  metres        x forward, y right,     degrees; yaw clockwise from
                                  z up, left-handed       above, pitch up, roll
Unreal, and wheel   centimetres   as the client's         as the client's
positions in it
==================  ============  ======================  ===========================

Both worlds share origin, x and z; y has the other sign. A camera of CARLA looks along
its x with y to the right and z up; ours are OpenCV's (x right, y down, z forward).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera, ray_lengths

CENTIMETRES = 100.0
FAR_PLANE = 1000.0  # metres; what a depth image says where there is nothing
_FULL_CODE = (1 << 24) - 1
_MIRROR = np.array([1.0, -1.0, 1.0])
_SQUARE = 1e-5  # relative difference of focal lengths that counts as none
_CENTRED_PX = 1e-3

#: Columns: a camera's right, down and forward in the axes of a body of ours.
BODY_FROM_OPENCV = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0, 0, 0, 1]]
)


@dataclass(frozen=True)
class CarlaPose:
    """Location and rotation as `carla.Transform` holds them.

    Args:
        x, y, z: metres, left-handed.
        pitch: degrees, positive looks up.
        yaw: degrees, positive turns right.
        roll: degrees, positive leans to the right.
    """

    x: float
    y: float
    z: float
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


def point_from_carla(metres: ArrayLike) -> np.ndarray:
    """Convert points or directions (..., 3) of the client API to our axes, metres."""
    return np.asarray(metres, np.float64) * _MIRROR + 0.0  # no -0


def point_to_carla(metres: ArrayLike) -> np.ndarray:
    """Convert points or directions (..., 3) of ours to the client API's, metres."""
    return np.asarray(metres, np.float64) * _MIRROR + 0.0  # no -0


def point_from_unreal(centimetres: ArrayLike) -> np.ndarray:
    """Convert points (..., 3) of Unreal, in centimetres, to our axes and metres."""
    return point_from_carla(np.asarray(centimetres, np.float64) / CENTIMETRES)


def body_from_carla(pose: CarlaPose) -> np.ndarray:
    """Convert the pose of an actor.

    Unreal turns by roll, then pitch, then yaw; mirrored in y, yaw and pitch change
    their sign and roll does not.

    Returns:
        body_to_world (4, 4), float64: x forward, y left, z up; metres.
    """
    angles_deg = [-pose.yaw, -pose.pitch, pose.roll]
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZYX", angles_deg, degrees=True).as_matrix()
    matrix[:3, 3] = point_from_carla([pose.x, pose.y, pose.z])
    return matrix


def body_to_carla(body_to_world: ArrayLike) -> CarlaPose:
    """Convert body_to_world (4, 4), metres, to the pose of an actor.

    A body that points straight up or down gets roll 0.
    """
    matrix = np.asarray(body_to_world, np.float64)
    rotation = matrix[:3, :3]
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(rotation[2, 0], level)
    if level > 1e-9:
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        roll = math.atan2(rotation[2, 1], rotation[2, 2])
    else:
        yaw, roll = math.atan2(-rotation[0, 1], rotation[1, 1]), 0.0
    x, y, z = point_to_carla(matrix[:3, 3]).tolist()
    return CarlaPose(
        x,
        y,
        z,
        pitch=math.degrees(pitch),
        yaw=-math.degrees(yaw),
        roll=math.degrees(roll),
    )


def camera_from_carla(pose: CarlaPose) -> np.ndarray:
    """Convert the pose of a camera actor to camera_to_world (4, 4), OpenCV axes."""
    return body_from_carla(pose) @ BODY_FROM_OPENCV


def camera_to_carla(camera_to_world: ArrayLike) -> CarlaPose:
    """Convert camera_to_world (4, 4), OpenCV axes, to the pose of a camera actor."""
    return body_to_carla(np.asarray(camera_to_world, np.float64) @ BODY_FROM_OPENCV.T)


def field_of_view_deg(camera: Camera) -> float:
    """Return the attribute `fov` of a camera of CARLA: horizontal, degrees.

    Raises:
        InputError: the camera has distortion, pixels that are not square or a
            principal point off the centre, none of which CARLA's cameras have.
    """
    remedy = "; CARLA's cameras have none: take render.camera.from_fov"
    if camera.is_distorted:
        raise InputError(f"camera: distortion {camera.distortion}{remedy}")
    if abs(camera.fx / camera.fy - 1) > _SQUARE:
        raise InputError(
            f"camera: pixels that are not square, fx {camera.fx}, fy {camera.fy}"
            f"{remedy}"
        )
    off = camera.cx - 0.5 * camera.width, camera.cy - 0.5 * camera.height
    if max(map(abs, off)) > _CENTRED_PX:
        raise InputError(
            f"camera: a principal point {off[0]:g}, {off[1]:g} px off the centre"
            f"{remedy}"
        )
    return math.degrees(2 * math.atan(0.5 * camera.width / camera.fx))


def read_bgra(raw: bytes | memoryview, width: int, height: int) -> np.ndarray:
    """Return the pixels of a camera's buffer.

    Args:
        raw: `carla.Image.raw_data`.
        width: pixels, as the camera was made with.
        height: pixels.

    Returns:
        (height, width, 4), uint8: blue, green, red, alpha; a copy.

    Raises:
        InputError: the buffer has another size.
    """
    values = np.frombuffer(raw, np.uint8)
    if values.size != 4 * width * height:
        raise InputError(
            f"image from CARLA: {values.size} bytes; {width} x {height} pixels of BGRA "
            f"are {4 * width * height}"
        )
    return values.reshape(height, width, 4).copy()


def decode_colour(bgra: np.ndarray) -> np.ndarray:
    """Return (height, width, 3) uint8, sRGB, of pixels (height, width, 4), BGRA."""
    return np.ascontiguousarray(bgra[..., 2::-1])


def decode_depth(bgra: np.ndarray) -> np.ndarray:
    """Decode the image of a depth camera.

    The distance is ``1000 m (R + 256 G + 65536 B) / (2^24 - 1)``, measured along the
    optical axis.

    Args:
        bgra: (height, width, 4), uint8, not converted by a `carla.ColorConverter`.

    Returns:
        (height, width), float64, metres along the optical axis; infinite at the far
        plane of 1000 m, where the sky is.
    """
    blue, green, red = (bgra[..., i].astype(np.uint32) for i in range(3))
    code = red + 256 * green + 65536 * blue
    return np.where(code == _FULL_CODE, np.inf, FAR_PLANE * code / _FULL_CODE)


def along_rays(planar: np.ndarray, camera: Camera) -> np.ndarray:
    """Convert distances along the optical axis to distances along the pixels' rays.

    Args:
        planar: (height, width), metres along the optical axis; may be infinite.
        camera: intrinsics.

    Returns:
        (height, width), float32, metres through the pixels' centres.
    """
    return (planar * ray_lengths(camera)).astype(np.float32)
