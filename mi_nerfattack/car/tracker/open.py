"""Trackers by the words of a command line."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from mi_nerfattack.capture.pose_files import read_poses
from mi_nerfattack.car.devices import (
    AbstractTracker,
    Clock,
    DeviceLostError,
    TrackedPose,
)
from mi_nerfattack.car.tracker.motion_capture import KINDS, MotionCaptureTracker
from mi_nerfattack.car.tracker.object_stream import Convention
from mi_nerfattack.car.tracker.vicon import PORT, ViconTracker
from mi_nerfattack.deploy.replay.mcap import read_vehicle_poses
from mi_nerfattack.deploy.replay.recording import Track
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount, camera_to_body


class ReplayTracker(AbstractTracker):
    """Poses of one vehicle, at the times between them from the moment it is made.

    Args:
        track: times, and where the body was: its matrices are taken as the body's.
        clock: of the poses' times.
    """

    def __init__(self, track: Track, clock: Clock = time.monotonic) -> None:
        self._track, self._clock = track, clock
        self._times = clock() + track.times - track.times[0]
        self._is_closed = False

    def newest(self, body: str) -> TrackedPose | None:
        """Return the newest pose, whatever the body is called.

        Raises:
            DeviceLostError: the last pose has been, as long as there were between
                poses at most.
        """
        del body
        now, times = self._clock(), self._times
        over = times[-1] + (np.diff(times).max() if len(times) > 1 else 0.0)
        if self._is_closed or now > over:
            why = "it is closed" if self._is_closed else "the recording is over"
            raise DeviceLostError(f"{self._track.where}: {why}")
        index = max(int(np.searchsorted(times, now, side="right")) - 1, 0)
        matrix = self._track.camera_to_world[index]
        return TrackedPose(matrix, float(times[index]), index)

    def close(self) -> None:
        """Let go of the recording."""
        self._is_closed = True


def read_body_track(path: Path, mount: CameraMount) -> Track:
    """Read when a vehicle was where.

    Args:
        path: an MCAP log, or a pose file (.csv, .toml, .json) with times.
        mount: of the camera, where the file has the camera's poses.

    Raises:
        InputError: it cannot be read, or has no times.
    """
    if path.suffix.lower() == ".mcap":
        times, poses = read_vehicle_poses(path, mount)
        return Track(str(path), times, poses)
    table = read_poses(path, mount)
    if table.times is None:
        raise InputError(f"{path}: no times; add a column time_s, seconds")
    to_body = np.linalg.inv(camera_to_body(mount))
    return Track(str(path), table.times, table.camera_to_world @ to_body)


FORMS = (
    f"vicon:HOST[:PORT] (this computer's address, 0.0.0.0 for all; {PORT}), "
    "motioncapture:KIND:HOST, replay:FILE"
)


def open_tracker(
    text: str,
    mount: CameraMount,
    convention: Convention = "euler",
    sender: str | None = None,
    clock: Clock = time.monotonic,
) -> AbstractTracker:
    """Open the tracker that a word names.

    Args:
        text: one of `FORMS`.
        mount: of the camera, for recordings of the camera's poses.
        convention: of VICON's rotations, see `turns`.
        sender: address of VICON's computer; None for the first that sends.
        clock: of the poses' times.

    Raises:
        InputError: it names none, or one that cannot be opened.
        SetupError: its package is not installed.
    """
    kind, _, source = text.partition(":")
    if kind == "vicon":
        host, port = _host_and_port(text, source)
        return ViconTracker(host, port, convention, sender=sender, clock=clock)
    if kind == "motioncapture":
        system, _, host = source.partition(":")
        if not system or not (host or system == "mock"):
            raise InputError(
                f"tracker {text!r}: must be motioncapture:KIND:HOST; kinds are "
                f"{', '.join(KINDS)}"
            )
        return MotionCaptureTracker(system, host, clock=clock)
    if kind == "replay" and source:
        return ReplayTracker(read_body_track(Path(source), mount), clock)
    raise InputError(f"tracker {text!r}: must be {FORMS}")


def _host_and_port(text: str, address: str) -> tuple[str, int]:
    host, colon, port = address.partition(":")
    if not host or (colon and not (port.isascii() and port.isdigit())):
        raise InputError(f"tracker {text!r}: must be vicon:HOST or vicon:HOST:PORT")
    return host, int(port) if colon else PORT
