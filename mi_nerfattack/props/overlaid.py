"""A camera in whose frames an attacked box stands, by the tracked pose of the car."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_nerfattack.car.devices import (
    AbstractCamera,
    AbstractTracker,
    DeviceLostError,
    Frame,
    TrackedPose,
)
from mi_nerfattack.car.drive.rig import Overlaid
from mi_nerfattack.props.attacked import read_box
from mi_nerfattack.props.overlay import Overlay
from mi_nerfattack.render.camera.intrinsics import CameraMount, camera_to_body
from mi_nerfattack.render.camera.pose import poses_at

_MAX_POSES = 64  # poses: a second and more of most trackers


class OverlaidCamera(AbstractCamera):
    """Puts a box into every frame of a camera, from where the car was at its time.

    The pose at a frame's time is interpolated between the two tracked poses around it
    (see `poses_at`); there is no frame before the first pose. Poses are
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
        self._poses: deque[TrackedPose] = deque(maxlen=_MAX_POSES)
        self._frame: Frame | None = None

    def newest(self) -> Frame | None:
        """Return the newest frame with the box in it."""
        with suppress(DeviceLostError):
            self._take(self._tracker.newest(self._body))
        frame = self._inner.newest()
        if frame is None or not self._poses:
            return None
        if self._frame is None or self._frame.index != frame.index:
            times = np.array([pose.time_s for pose in self._poses])
            poses = np.stack([pose.body_to_world for pose in self._poses])
            (body,), _ = poses_at(times, poses, np.array([frame.time_s]))
            shown = self._overlay.apply(frame.image, body @ self._to_body)
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


def overlaid_by(run: Path, body: str) -> Overlaid:
    """Return what puts the attacked box of a run into a camera's frames.

    Args:
        run: finished run of `attack`, read when the camera is open.
        body: the tracker's name of the car.
    """

    def overlaid(
        camera: AbstractCamera, tracker: AbstractTracker, mount: CameraMount
    ) -> AbstractCamera:
        box, _ = read_box(run)
        overlay = Overlay(box, camera.camera, keyed=False)
        return OverlaidCamera(camera, overlay, tracker, body=body, mount=mount)

    return overlaid
