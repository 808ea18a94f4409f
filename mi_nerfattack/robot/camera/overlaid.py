"""A camera in whose frames an attacked box stands, by the tracked pose of the car."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mi_nerfattack.render.camera.intrinsics import CameraMount, camera_to_body
from mi_nerfattack.robot.devices import (
    AbstractCamera,
    AbstractTracker,
    DeviceLostError,
    Frame,
    TrackedPose,
)
from mi_nerfattack.robot.overlay import Overlay

_KEPT = 64  # poses: a second and more of most trackers


class OverlaidCamera(AbstractCamera):
    """Puts a box into every frame of a camera, from where the car was at its time.

    The pose at a frame's time lies between the two tracked ones around it, or is the
    nearest where none came later; there is no frame before the first pose. Poses are
    asked for whenever a frame is: ask more often than the tracker measures. That a
    tracker is lost, its own caller hears.

    Args:
        camera: whose frames they are; closed with this one.
        overlay: of the box, in frames of that camera.
        tracker: of the car; not closed here.
        body: its name of the car.
        mount: of the camera on the car.
    """

    def __init__(
        self,
        camera: AbstractCamera,
        overlay: Overlay,
        tracker: AbstractTracker,
        body: str,
        mount: CameraMount,
    ) -> None:
        self.camera = camera.camera
        self._inner, self._overlay = camera, overlay
        self._tracker, self._body = tracker, body
        self._to_body = camera_to_body(mount)
        self._poses: deque[TrackedPose] = deque(maxlen=_KEPT)
        self._frame: Frame | None = None

    def newest(self) -> Frame | None:
        """Return the newest frame with the box in it."""
        with suppress(DeviceLostError):
            self._take(self._tracker.newest(self._body))
        frame = self._inner.newest()
        if frame is None or not self._poses:
            return None
        if self._frame is None or self._frame.index != frame.index:
            to_world = pose_at(list(self._poses), frame.time_s) @ self._to_body
            shown = self._overlay.apply(frame.image, to_world)
            self._frame = replace(frame, image=shown)
        return self._frame

    def _take(self, pose: TrackedPose | None) -> None:
        """Keep a pose that is new and can be one."""
        if pose is None or not np.isfinite(pose.body_to_world).all():
            return
        if not self._poses or pose.time_s > self._poses[-1].time_s:
            self._poses.append(pose)

    def close(self) -> None:
        """Close the camera."""
        self._inner.close()


def pose_at(poses: list[TrackedPose], time_s: float) -> np.ndarray:
    """Return the pose (4, 4) of a body at a time, between the poses around it.

    Args:
        poses: at least one, times increasing.
        time_s: before the first and after the last, these are returned.
    """
    times = [pose.time_s for pose in poses]
    later = int(np.searchsorted(times, time_s))
    if later in (0, len(poses)):
        return poses[min(later, len(poses) - 1)].body_to_world
    before, after = (poses[i].body_to_world for i in (later - 1, later))
    share = (time_s - times[later - 1]) / (times[later] - times[later - 1])
    result = np.eye(4)
    turns = Slerp([0, 1], Rotation.from_matrix([before[:3, :3], after[:3, :3]]))
    result[:3, :3] = turns(share).as_matrix()
    result[:3, 3] = (1 - share) * before[:3, 3] + share * after[:3, 3]
    return result
