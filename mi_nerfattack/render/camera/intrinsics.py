"""Camera intrinsics and poses, in NumPy alone; `render.camera.lens` has the rays.

World: right-handed, z up, metres. A camera's frame is OpenCV's (x right, y down, z
forward); its pose is a 4x4 float64 matrix named `camera_to_world`. Other frames are
converted by `render.camera.conventions`. Pixels: (0, 0) is the top-left
corner of the image, so the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.distortion import (
    direction,
    is_invertible,
    unbend,
    undistort,
)

#: Numbers of a camera, beyond which rays overflow in single precision.
_SMALLEST, _LARGEST = 1e-6, 1e9


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV's radial-tangential distortion, or a fisheye.

    Args:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels from the top-left corner of the image; to one
            that counts from the centre of the first pixel, as OpenCV's, add 0.5.
        k1, k2, p1, p2: distortion as in `cv2.projectPoints`, without unit.
        k3, k4: of a fisheye, which has no p1 and p2, as in `cv2.fisheye`.
        is_fisheye: whether it is one.

    Raises:
        InputError: a size or focal length is not positive, a size is no integer, a
            value is not finite or belongs to another lens, or the distortion cannot be
            inverted everywhere in the image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    is_fisheye: bool = False

    def __post_init__(self) -> None:
        numbers = dict(vars(self))
        del numbers["is_fisheye"]
        for name, value in numbers.items():
            if not math.isfinite(value):
                raise InputError(f"camera.{name}: {value}; must be finite")
            if name in ("width", "height", "fx", "fy") and value <= 0:
                raise InputError(f"camera.{name}: {value}; must be positive")
            least = _SMALLEST if name in ("fx", "fy") else 0
            if not least <= abs(value) <= _LARGEST:
                raise InputError(
                    f"camera.{name}: {value}; at most {_LARGEST:g}, and focal lengths "
                    f"at least {_SMALLEST:g}"
                )
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer):
                raise InputError(
                    f"camera.{name}: {value!r}; must be an int, a whole number of px"
                )
        for name in ("p1", "p2") if self.is_fisheye else ("k3", "k4"):
            if numbers[name]:
                lens = (
                    "a fisheye has" if self.is_fisheye else "without is_fisheye it is"
                )
                raise InputError(f"camera.{name}: {numbers[name]}; {lens} 0")
        if self.is_distorted:
            self._check_distortion()

    @property
    def distortion(self) -> tuple[float, ...]:
        """The coefficients k1, k2, p1, p2, or k1 to k4 and True, as `distort` has."""
        if self.is_fisheye:
            return self.k1, self.k2, self.k3, self.k4, True
        return self.k1, self.k2, self.p1, self.p2

    @property
    def is_distorted(self) -> bool:
        """Whether it is a fisheye, or any distortion coefficient is not zero."""
        return any(self.distortion)

    @property
    def largest_slope(self) -> float:
        """Largest tangent of angles to a fisheye's axis; infinite from 90 deg on."""
        u, v = self._grid()
        angle = float(unbend(np.hypot(u, v), *self.distortion[:4]).max())
        return math.tan(angle) if angle < 0.5 * math.pi else math.inf

    def _grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return distorted positions all over the image, border included."""
        u, v = np.linspace(0, self.width, 33), np.linspace(0, self.height, 33)
        x, y = np.meshgrid((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        return x, y

    @property
    def fov_x_deg(self) -> float:
        """Angle between the left and the right image border, without distortion."""
        sides = np.array([self.width - self.cx, self.cx]) / self.fx
        if self.is_fisheye:
            angles = unbend(sides, *self.distortion[:4])
            return math.degrees(float(angles.sum()))
        return math.degrees(sum(map(math.atan, sides)))

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same picture at another size in pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def _check_distortion(self) -> None:
        x, y = self._grid()
        if not is_invertible(x, y, self.distortion, 1e-2 / max(self.fx, self.fy)):
            names = "k1, k2, k3, k4" if self.is_fisheye else "k1, k2, p1, p2"
            raise InputError(
                f"camera.{names}: {self.distortion[:4]}; this distortion folds "
                "the image over itself and cannot be inverted; calibrate again, or "
                "undistort the images, or crop them to what the lens shows"
            )


def from_fov(width: int, height: int, fov_x_deg: float) -> Camera:
    """Make a centred pinhole camera with square pixels.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        fov_x_deg: horizontal field of view in degrees, in (0, 180).
    """
    if not 0 < fov_x_deg < 180:
        raise InputError(f"fov_x_deg: {fov_x_deg}; must be between 0 and 180 degrees")
    focal = 0.5 * width / math.tan(math.radians(0.5 * fov_x_deg))
    return Camera(width, height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)


def ray_slopes(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return x / z and y / z of the rays through pixels' centres, (height, width).

    Raises:
        InputError: the camera is a fisheye that sees 90 degrees from its axis.
    """
    if camera.is_fisheye and math.isinf(camera.largest_slope):
        raise InputError(
            "camera: a fisheye that sees 90 degrees and more from its axis; here it "
            "must see less: crop its images"
        )
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return undistort(x, y, *camera.distortion) if camera.is_distorted else (x, y)


def ray_lengths(camera: Camera) -> np.ndarray:
    """Return how far each pixel's ray goes per distance along the optical axis.

    Returns:
        (height, width), float64, at least 1, of rays through the pixels' centres; NaN
        where a fisheye sees 90 degrees and more from its axis.
    """
    if camera.is_fisheye:
        # A ray at the angle a to the axis goes 1 / cos(a) per distance along the axis
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        x, y = (u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy
        along = direction(x, y, *camera.distortion[:4])[2]
        return np.where(along > 0, 1 / np.where(along > 0, along, 1), np.nan)
    x, y = ray_slopes(camera)
    return np.sqrt(1 + x * x + y * y)


def look_at(eye: ArrayLike, target: ArrayLike) -> np.ndarray:
    """Place an upright camera (up is +z).

    Args:
        eye: (3,), metres.
        target: (3,), metres, on the optical axis; straight above or below eye, the
            top of the image points to +y.

    Returns:
        camera_to_world: (4, 4), OpenCV axes, float64.
    """
    eye = np.asarray(eye, np.float64)
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    # Right is horizontal; a camera that looks straight up or down has +y at the top
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    # Columns: right, down, forward
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = eye
    return matrix


@dataclass(frozen=True)
class CameraMount:
    """Where a camera sits on a vehicle whose state is (px, py, theta).

    Args:
        height_m: above the ground plane z = 0.
        forward_m: ahead of the state's reference point.
        pitch_deg: rotation of the optical axis, positive looks down.
        left_m: to the left of the reference point.
        yaw_deg: rotation about the vertical, positive looks to the left.

    Raises:
        InputError: a value is not finite.
    """

    height_m: float = 1.4
    forward_m: float = 0.5
    pitch_deg: float = 6.0
    left_m: float = 0.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise InputError(f"mount.{name}: {value}; must be finite")

    def described(self) -> dict[str, float]:
        """Return the numbers as JSON, `left_m` and `yaw_deg` only where not 0.

        So a camera that looks ahead from the middle is described as it was before
        mounts had these two numbers, and what was made with it keeps its identity.
        """
        numbers = dict(vars(self))
        return {k: v for k, v in numbers.items() if v or k not in ("left_m", "yaw_deg")}


def mount_matrix(states: np.ndarray, mount: CameraMount) -> np.ndarray:
    """Place a mounted camera in the world.

    Args:
        states: (n, 3): px, py in metres, theta in radians.
        mount: where the camera sits.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes, float64.
    """
    px, py, theta = np.asarray(states, np.float64).reshape(-1, 3).T
    pitch, heading = math.radians(mount.pitch_deg), theta + math.radians(mount.yaw_deg)
    sin_heading, cos_heading = np.sin(heading), np.cos(heading)
    matrix = np.zeros((len(px), 4, 4))
    # x, to the right: horizontal, at right angles to the camera's heading
    matrix[:, 0, 0], matrix[:, 1, 0] = sin_heading, -cos_heading
    # y, down: tilted by the pitch
    matrix[:, 0, 1] = -cos_heading * math.sin(pitch)
    matrix[:, 1, 1] = -sin_heading * math.sin(pitch)
    matrix[:, 2, 1] = -math.cos(pitch)
    # z, the optical axis: along the camera's heading, down by the pitch
    matrix[:, 0, 2] = cos_heading * math.cos(pitch)
    matrix[:, 1, 2] = sin_heading * math.cos(pitch)
    matrix[:, 2, 2] = -math.sin(pitch)
    # The camera's place turns with the vehicle, not with the camera's yaw
    sin_theta, cos_theta = np.sin(theta), np.cos(theta)
    matrix[:, 0, 3] = px + mount.forward_m * cos_theta - mount.left_m * sin_theta
    matrix[:, 1, 3] = py + mount.forward_m * sin_theta + mount.left_m * cos_theta
    matrix[:, 2, 3] = mount.height_m
    matrix[:, 3, 3] = 1
    return matrix


def camera_to_body(mount: CameraMount) -> np.ndarray:
    """Return the pose (4, 4) of a mounted camera in its vehicle's frame."""
    return mount_matrix(np.zeros((1, 3)), mount)[0]


def planar_body(state: np.ndarray) -> np.ndarray:
    """Return body_to_world (4, 4) of a state (m,) on the ground z = 0."""
    x, y, theta = state[:3]
    matrix = np.eye(4)
    matrix[:2, 0] = np.cos(theta), np.sin(theta)
    matrix[:2, 1] = -np.sin(theta), np.cos(theta)
    matrix[:2, 3] = x, y
    return matrix


def planar_state(body_to_world: np.ndarray) -> np.ndarray:
    """Return x, y (metres) and heading (radians), (..., 3), of poses (..., 4, 4)."""
    heading = np.arctan2(body_to_world[..., 1, :1], body_to_world[..., 0, :1])
    return np.concatenate([body_to_world[..., :2, 3], heading], -1)
