"""The interface of recorded drives: frames, times and poses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict import require_near
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    camera_to_body,
    planar_state,
)
from mi_nerfattack.render.camera.pose import POSE_REACH_S, check_rigid, poses_at
from mi_nerfattack.vehicle.route.polyline import LARGEST_M


@dataclass(frozen=True, eq=False)
class Track:
    """When and where frames were taken.

    Args:
        where: the file, for messages.
        times: (n,), seconds, increasing.
        camera_to_world: (n, 4, 4), OpenCV axes, metres.

    Raises:
        InputError: no frame, times that do not increase, or a pose that is none.
    """

    where: str
    times: np.ndarray
    camera_to_world: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.times)
        if n == 0 or self.camera_to_world.shape != (n, 4, 4):
            raise InputError(
                f"{self.where}: {n} times and poses of shape "
                f"{self.camera_to_world.shape}; needs at least one frame and a pose "
                "(4, 4) for each"
            )
        check_times(self.where, self.times)
        require_near(self.where, self.camera_to_world[:, :3, 3])
        for index, matrix in enumerate(self.camera_to_world):
            check_rigid(matrix, f"{self.where}: pose of frame {index}")
            if np.abs(matrix).max() > LARGEST_M:
                raise InputError(
                    f"{self.where}: pose of frame {index} is at "
                    f"{matrix[:3, 3].tolist()}; at most {LARGEST_M:g} m"
                )


def vehicle_states(track: Track, mount: CameraMount) -> np.ndarray:
    """Return x, y (metres) and heading (radians) of the vehicle, (n, 3).

    Args:
        track: poses of its camera.
        mount: of the camera on it.
    """
    to_body = np.linalg.inv(camera_to_body(mount))
    return planar_state(track.camera_to_world @ to_body)


def check_times(where: str, times: np.ndarray) -> None:
    """Raise `InputError` unless times (n,) are finite and increase."""
    if not np.isfinite(times).all():
        index = int(np.argmin(np.isfinite(times)))
        raise InputError(f"{where}: time of frame {index} is {times[index]}; finite")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        index = int(back[0])
        raise InputError(
            f"{where}: frame {index + 1} is at {times[index + 1]:g} s, the one before "
            f"at {times[index]:g} s; sort the frames by time"
        )


class AbstractRecording(ABC):
    """A recorded drive, whose frames are read when they are asked for.

    Attributes:
        camera: intrinsics of all frames.
        track: times and poses.
        remarks: what of the file is left out, for a person.
    """

    camera: Camera
    track: Track
    remarks: tuple[str, ...] = ()

    @abstractmethod
    def image(self, index: int) -> np.ndarray:
        """Read frame `index`: (height, width, 3), uint8, sRGB.

        Raises:
            InputError: it cannot be read or has another size than the camera.
        """

    @abstractmethod
    def depth(self, index: int) -> np.ndarray:
        """Read the depth of frame `index`: (height, width), float32.

        Metres along the ray; infinite where nothing was met or nothing is known.
        """

    def close(self) -> None:  # noqa: B027  most have nothing to close
        """Let go of files."""


def no_depth(camera: Camera) -> np.ndarray:
    """Return the depth (height, width) of a frame of which none was recorded."""
    return np.full((camera.height, camera.width), np.inf, np.float32)


def checked_image(where: str, image: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a copy of an image as (height, width, 3).

    Args:
        where: file and frame, for messages.
        image: (h, w, 3 or 4), uint8; alpha must be full.
        camera: whose size it must have.

    Raises:
        InputError: another size, or an alpha below 255.
    """
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{where}: {width} x {height} px; the camera has {camera.width} x "
            f"{camera.height} px, and all frames must have one size"
        )
    if image.shape[2] == 4 and image[..., 3].min() < 255:
        raise InputError(f"{where}: transparent pixels; frames must be opaque")
    return np.array(image[..., :3], order="C")


def poses_of_frames(
    frames: str,
    poses: str,
    times: np.ndarray,
    pose_times: np.ndarray,
    matrices: np.ndarray,
) -> np.ndarray:
    """Return the pose of each frame, interpolated in time.

    Args:
        frames: where the frames are from, for messages.
        poses: where the poses are from, for messages.
        times: (n,), of the frames, seconds, increasing.
        pose_times: (m,), of the poses, seconds.
        matrices: (m, 4, 4), the poses.

    Returns:
        (n, 4, 4).

    Raises:
        InputError: times of poses that do not increase, or a frame without a pose.
    """
    check_times(poses, pose_times)
    frame_poses, is_known = poses_at(pose_times, matrices, times)
    if not is_known.all():
        frame = int(np.argmin(is_known))
        raise InputError(
            f"{frames}: frame {frame} at {times[frame]:g} s has no pose within "
            f"{POSE_REACH_S:g} s in {poses}; add poses, or take the frame out"
        )
    return frame_poses
