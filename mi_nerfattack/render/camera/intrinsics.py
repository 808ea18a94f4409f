"""Camera intrinsics, poses and rays.

World: right-handed, z up, metres. A camera's frame is OpenCV's (x right, y down, z
forward); its pose is a 4x4 float64 matrix named `camera_to_world`. Other frames are
converted by `render.camera.conventions`. Pixels: (0, 0) is the top-left
corner of the image, so the centre of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.distortion import distort, jacobian, undistort


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV's radial-tangential distortion.

    Args:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels from the top-left corner of the image; to one
            that counts from the centre of the first pixel, as OpenCV's, add 0.5.
        k1, k2, p1, p2: distortion as in `cv2.projectPoints`, without unit.

    Raises:
        InputError: a size or focal length is not positive, a size is no integer, a
            value is not finite, or the distortion cannot be inverted everywhere in the
            image.
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

    def __post_init__(self) -> None:
        """Check the ranges, and that the distortion has an inverse."""
        for name in ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"):
            value = getattr(self, name)
            if not math.isfinite(value):
                raise InputError(f"camera.{name}: {value}; must be finite")
            if name in ("width", "height", "fx", "fy") and value <= 0:
                raise InputError(f"camera.{name}: {value}; must be positive")
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer):
                raise InputError(
                    f"camera.{name}: {value!r}; must be an int, a whole number of px"
                )
        if self.is_distorted:
            self._check_distortion()

    @property
    def distortion(self) -> tuple[float, float, float, float]:
        """The coefficients k1, k2, p1, p2."""
        return self.k1, self.k2, self.p1, self.p2

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return any(self.distortion)

    @property
    def fov_x_deg(self) -> float:
        """Angle between the left and the right image border, without distortion."""
        right = math.atan((self.width - self.cx) / self.fx)
        return math.degrees(right + math.atan(self.cx / self.fx))

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
        u = np.linspace(0, self.width, 33)
        v = np.linspace(0, self.height, 33)
        x, y = np.meshgrid((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        with np.errstate(all="ignore"):
            undistorted = undistort(x, y, *self.distortion)
            back_x, back_y = distort(*undistorted, *self.distortion)
            determinant = jacobian(*undistorted, *self.distortion)[3]
            error = np.maximum(abs(back_x - x) * self.fx, abs(back_y - y) * self.fy)
        if not (np.all(error < 1e-2) and np.all(determinant > 0)):
            raise InputError(
                f"camera.k1, k2, p1, p2: {self.distortion}; this distortion folds "
                "the image over itself and cannot be inverted; calibrate again or "
                "undistort the images first"
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
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)


def ray_slopes(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return x / z and y / z of the rays through pixels' centres, (height, width)."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return undistort(x, y, *camera.distortion) if camera.is_distorted else (x, y)


def ray_lengths(camera: Camera) -> np.ndarray:
    """Return how far each pixel's ray goes per distance along the optical axis.

    Returns:
        (height, width), float64, at least 1, of rays through the pixels' centres.
    """
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
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
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

    Raises:
        InputError: a value is not finite.
    """

    height_m: float = 1.4
    forward_m: float = 0.5
    pitch_deg: float = 6.0

    def __post_init__(self) -> None:
        """Check that all are finite."""
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise InputError(f"mount.{name}: {value}; must be finite")


def mount_pose(
    state: tuple[Any, Any, Any], height_m: float, forward_m: float, pitch_deg: float
) -> tuple[Any, tuple[Any, Any, Any]]:
    """Place a mounted camera in the world; differentiable in the state.

    Args:
        state: px, py (metres), theta (radians), each a `mi.Float` with one entry per
            vehicle.
        height_m: as in `CameraMount`; it and the next two reach the kernel as opaque
            values, so that another mount needs no other kernel.
        forward_m: as in `CameraMount`.
        pitch_deg: as in `CameraMount`.

    Returns:
        origin (`mi.Point3f`) and the columns (right, down, forward) of the rotation
        (`mi.Vector3f`, unit length), one entry per vehicle.
    """
    px, py, theta = (mi.Float(value) for value in state)
    height = dr.opaque(mi.Float, height_m)
    ahead = dr.opaque(mi.Float, forward_m)
    sin_pitch, cos_pitch = dr.sincos(dr.opaque(mi.Float, math.radians(pitch_deg)))
    sin_theta, cos_theta = dr.sincos(theta)
    origin = mi.Point3f(px + ahead * cos_theta, py + ahead * sin_theta, height)
    right = mi.Vector3f(sin_theta, -cos_theta, 0)
    down = mi.Vector3f(-cos_theta * sin_pitch, -sin_theta * sin_pitch, -cos_pitch)
    forward = mi.Vector3f(cos_theta * cos_pitch, sin_theta * cos_pitch, -sin_pitch)
    return origin, (right, down, forward)


def mount_matrix(states: np.ndarray, mount: CameraMount) -> np.ndarray:
    """Place a mounted camera in the world.

    Args:
        states: (n, 3): px, py in metres, theta in radians.
        mount: where the camera sits.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes, float64.
    """
    px, py, theta = np.asarray(states, np.float64).reshape(-1, 3).T
    pitch = math.radians(mount.pitch_deg)
    sin_theta, cos_theta = np.sin(theta), np.cos(theta)
    matrix = np.zeros((len(px), 4, 4))
    matrix[:, 0, 0], matrix[:, 1, 0] = sin_theta, -cos_theta
    matrix[:, 0, 1] = -cos_theta * math.sin(pitch)
    matrix[:, 1, 1] = -sin_theta * math.sin(pitch)
    matrix[:, 2, 1] = -math.cos(pitch)
    matrix[:, 0, 2] = cos_theta * math.cos(pitch)
    matrix[:, 1, 2] = sin_theta * math.cos(pitch)
    matrix[:, 2, 2] = -math.sin(pitch)
    matrix[:, 0, 3] = px + mount.forward_m * cos_theta
    matrix[:, 1, 3] = py + mount.forward_m * sin_theta
    matrix[:, 2, 3] = mount.height_m
    matrix[:, 3, 3] = 1
    return matrix


def camera_to_body(mount: CameraMount) -> np.ndarray:
    """Return the pose (4, 4) of a mounted camera in its vehicle's frame."""
    return mount_matrix(np.zeros((1, 3)), mount)[0]


def pose_arrays(camera_to_world: np.ndarray) -> tuple[Any, tuple[Any, Any, Any]]:
    """Copy camera_to_world (n, 4, 4), OpenCV, to `mi.Point3f` and three `mi.Vector3f`.

    Returns:
        origin and the columns (right, down, forward) with n entries each, as
        `generate_rays` takes them.
    """
    matrix = np.asarray(camera_to_world, np.float64).reshape(-1, 4, 4)
    # not from NumPy memory, whose alignment would select one of several kernels
    top = matrix[:, :3].transpose(2, 1, 0).tolist()
    columns = [mi.Vector3f(*(mi.Float(row) for row in column)) for column in top]
    dr.make_opaque(columns)
    return mi.Point3f(columns[3]), (columns[0], columns[1], columns[2])


def generate_rays(
    camera: Camera,
    origin: Any,
    rotation: tuple[Any, Any, Any],
    n_poses: int,
    subpixel: Any = None,
) -> tuple[Any, Any]:
    """Make one ray through every pixel of every pose; differentiable in the poses.

    Rays are ordered pose by pose, row by row, top-left pixel first, so that they
    reshape to (n_poses, height, width). Neither poses nor intrinsics are compiled into
    the kernel; image size, n_poses and whether there is distortion are.

    Args:
        camera: intrinsics.
        origin: `mi.Point3f`, n_poses entries (or one, if n_poses is 1), metres.
        rotation: columns (right, down, forward) as `mi.Vector3f`, like origin.
        n_poses: number of poses.
        subpixel: `mi.Point2f` in [-0.5, 0.5], offset in pixels from the centre of
            the pixel, one for all or one per ray; None for the centre.

    Returns:
        origins (`mi.Point3f`, metres) and unit directions (`mi.Vector3f`), in the
        world, n_poses * height * width entries.

    Raises:
        ValueError: the pose arrays do not have n_poses entries.
    """
    n_pixels = camera.width * camera.height
    index = dr.arange(mi.UInt32, n_poses * n_pixels)
    pose = index // n_pixels
    pixel = index - pose * n_pixels
    row = pixel // camera.width
    column = pixel - row * camera.width
    position = mi.Point2f(column, row) + 0.5
    if subpixel is not None:
        position += subpixel

    def spread(value: Any) -> Any:
        result = type(value)()
        for i in range(3):
            component = mi.Float(value[i])
            if component.state == dr.VarState.Literal:
                dr.make_opaque(component)
            size = dr.width(component)
            if size not in (1, n_poses):
                raise ValueError(
                    f"generate_rays: a pose array has {size} entries; "
                    f"n_poses is {n_poses}"
                )
            result[i] = component if size == 1 else dr.gather(mi.Float, component, pose)
        return result

    right, down, forward = (spread(mi.Vector3f(c)) for c in rotation)
    return pixel_rays(
        camera, spread(mi.Point3f(origin)), (right, down, forward), position
    )


def pixel_rays(
    camera: Camera, origin: Any, rotation: tuple[Any, Any, Any], position: Any
) -> tuple[Any, Any]:
    """Make the rays through given positions in the image; differentiable in the poses.

    Args:
        camera: intrinsics.
        origin: `mi.Point3f`, one entry per ray or one for all, metres.
        rotation: columns (right, down, forward) as `mi.Vector3f`, like origin.
        position: `mi.Point2f`, pixels from the top-left corner, one entry per ray.

    Returns:
        origins (`mi.Point3f`) and unit directions (`mi.Vector3f`), one per ray.
    """
    return lens_rays(Lens([camera]).of(mi.UInt32(0)), origin, rotation, position)


class Lens:
    """Intrinsics of cameras on the device; none is compiled into a kernel.

    Args:
        cameras: at least one; equal ones count as one.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        shared = cameras[:1] if len(set(cameras)) == 1 else cameras
        table = [(c.fx, c.fy, c.cx, c.cy, *c.distortion) for c in shared]
        count = 8 if any(c.is_distorted for c in shared) else 4
        self._columns = [mi.Float(list(v)) for v in list(zip(*table, strict=True))]
        self._columns = self._columns[:count]
        dr.make_opaque(self._columns)

    def of(self, index: Any) -> list[Any]:
        """Return fx, fy, cx, cy and, if any camera is distorted, k1, k2, p1, p2.

        Args:
            index: `mi.UInt32` (n,), of the cameras.
        """
        if dr.width(self._columns[0]) == 1:
            return self._columns
        return [dr.gather(mi.Float, column, index) for column in self._columns]

    def state(self) -> list[Any]:
        """Return the device arrays."""
        return self._columns


def lens_rays(
    lens: list[Any], origin: Any, rotation: tuple[Any, Any, Any], position: Any
) -> tuple[Any, Any]:
    """Make the rays through given positions in images; as `pixel_rays`.

    Args:
        lens: from `Lens.of`.
        origin: `mi.Point3f`, one entry per ray or one for all, metres.
        rotation: columns (right, down, forward) as `mi.Vector3f`, like origin.
        position: `mi.Point2f`, pixels from the top-left corner, one entry per ray.
    """
    fx, fy, cx, cy, *distortion = lens
    x = (position.x - cx) / fx
    y = (position.y - cy) / fy
    if distortion:
        x, y = undistort(x, y, *distortion)
    right, down, forward = rotation
    direction = dr.normalize(right * x + down * y + forward)
    origins = mi.Point3f(origin)
    for i in range(3):
        if dr.width(origins[i]) == 1:
            origins[i] = dr.select(dr.full(mi.Bool, True, dr.width(x)), origins[i], 0)
    return origins, direction
