"""Intrinsics of cameras on the device, and the rays through their pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.distortion import direction, undistort
from mi_nerfattack.render.camera.intrinsics import Camera


class Lens:
    """Intrinsics of cameras on the device; none is compiled into a kernel.

    Args:
        cameras: at least one; equal ones count as one.

    Raises:
        InputError: fisheyes are among others.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        shared = cameras[:1] if len(set(cameras)) == 1 else cameras
        if len({camera.is_fisheye for camera in shared}) > 1:
            raise InputError("cameras: fisheyes and others; give each kind by itself")
        self._is_fisheye = shared[0].is_fisheye
        table = [(c.fx, c.fy, c.cx, c.cy, *c.distortion[:4]) for c in shared]
        count = 8 if any(c.is_distorted for c in shared) else 4
        self._columns = [mi.Float(list(v)) for v in list(zip(*table, strict=True))]
        self._columns = self._columns[:count]
        dr.make_opaque(self._columns)

    def of(self, index: Any) -> list[Any]:
        """Return fx, fy, cx, cy and, if any camera is distorted, its `distortion`.

        Args:
            index: `mi.UInt32` (n,), of the cameras.
        """
        columns = self._columns
        if dr.width(columns[0]) > 1:
            columns = [dr.gather(mi.Float, column, index) for column in columns]
        return [*columns, True] if self._is_fisheye else columns

    def state(self) -> list[Any]:
        """Return the device arrays."""
        return self._columns


def lens_rays(
    lens: list[Any], origin: Any, rotation: tuple[Any, Any, Any], position: Any
) -> tuple[Any, Any]:
    """Make the rays through given positions in images; differentiable in the poses.

    Args:
        lens: from `Lens.of`.
        origin: `mi.Point3f`, one entry per ray or one for all, metres.
        rotation: columns (right, down, forward) as `mi.Vector3f`, like origin.
        position: `mi.Point2f`, pixels from the top-left corner, one entry per ray.

    Returns:
        origins (`mi.Point3f`) and unit directions (`mi.Vector3f`), one per ray.
    """
    fx, fy, cx, cy, *distortion = lens
    # Distorted positions on the image plane, at unit distance
    x = (position.x - cx) / fx
    y = (position.y - cy) / fy
    right, down, forward = rotation
    # Undistorted directions; a fisheye also sees 90 degrees and more from its axis
    if len(distortion) > 4:
        x, y, z = direction(x, y, *distortion[:4])
        towards = dr.normalize(right * x + down * y + forward * z)
    else:
        if distortion:
            x, y = undistort(x, y, *distortion)
        towards = dr.normalize(right * x + down * y + forward)
    # An origin for all rays becomes one entry per ray
    origins = mi.Point3f(origin)
    for i in range(3):
        if dr.width(origins[i]) == 1:
            origins[i] = dr.select(dr.full(mi.Bool, True, dr.width(x)), origins[i], 0)
    return origins, towards


def mount_pose(
    state: tuple[Any, Any, Any],
    height_m: Any,
    forward_m: float,
    pitch_deg: Any,
    left_m: float = 0.0,
    yaw_deg: float = 0.0,
) -> tuple[Any, tuple[Any, Any, Any]]:
    """Place a mounted camera in the world; differentiable in the state.

    Args:
        state: px, py (metres), theta (radians), each a `mi.Float` with one entry per
            vehicle.
        height_m: as in `CameraMount`, or a `mi.Float` with one entry per vehicle; it
            and all that follow reach the kernel as opaque values, so that another
            mount needs no other kernel.
        forward_m: as in `CameraMount`.
        pitch_deg: like the height.
        left_m: as in `CameraMount`.
        yaw_deg: as in `CameraMount`.

    Returns:
        origin (`mi.Point3f`) and the columns (right, down, forward) of the rotation
        (`mi.Vector3f`, unit length), one entry per vehicle.
    """
    px, py, theta = (mi.Float(value) for value in state)
    # The numbers of the mount: opaque, or one entry per vehicle
    if isinstance(pitch_deg, mi.Float):
        pitch = pitch_deg * (math.pi / 180)
    else:
        pitch = dr.opaque(mi.Float, math.radians(pitch_deg))
    height, ahead, left = (
        value if isinstance(value, mi.Float) else dr.opaque(mi.Float, value)
        for value in (height_m, forward_m, left_m)
    )
    sin_pitch, cos_pitch = dr.sincos(pitch)
    sin_theta, cos_theta = dr.sincos(theta)
    # The offsets turn with the vehicle, not with the camera's yaw
    origin = mi.Point3f(
        px + ahead * cos_theta - left * sin_theta,
        py + ahead * sin_theta + left * cos_theta,
        height,
    )
    # The optical axis: the vehicle's heading turned to the left, by a sum of angles
    # that changes no bit of values and derivatives where the turn is 0
    yaw = math.radians(yaw_deg)
    sin_yaw, cos_yaw = (dr.opaque(mi.Float, f(yaw)) for f in (math.sin, math.cos))
    sin_theta, cos_theta = (
        sin_theta * cos_yaw + cos_theta * sin_yaw,
        cos_theta * cos_yaw - sin_theta * sin_yaw,
    )
    # Right stays horizontal; the pitch tilts the other two columns
    right = mi.Vector3f(sin_theta, -cos_theta, 0)
    down = mi.Vector3f(-cos_theta * sin_pitch, -sin_theta * sin_pitch, -cos_pitch)
    forward = mi.Vector3f(cos_theta * cos_pitch, sin_theta * cos_pitch, -sin_pitch)
    return origin, (right, down, forward)


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
    # Pose, row and column of each ray, (n_poses * n_pixels,)
    index = dr.arange(mi.UInt32, n_poses * n_pixels)
    pose = index // n_pixels
    pixel = index - pose * n_pixels
    row = pixel // camera.width
    column = pixel - row * camera.width
    # Position in the image, pixels from the top-left corner
    position = mi.Point2f(column, row) + 0.5
    if subpixel is not None:
        position += subpixel

    # From n_poses entries to one entry per ray; a single entry stays single
    def spread(value: Any) -> Any:
        result = type(value)()
        for i in range(3):
            component = mi.Float(value[i])
            # A literal would be compiled into the kernel
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

    # Now each ray has the pose of its image
    right, down, forward = (spread(mi.Vector3f(c)) for c in rotation)
    lens, origin = Lens([camera]).of(mi.UInt32(0)), spread(mi.Point3f(origin))
    return lens_rays(lens, origin, (right, down, forward), position=position)
