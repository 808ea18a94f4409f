"""Trackers by the words of a command line."""

from __future__ import annotations

import time
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.robot.devices import AbstractTracker, Clock
from mi_nerfattack.robot.tracker.motion_capture import KINDS, MotionCaptureTracker
from mi_nerfattack.robot.tracker.object_stream import Convention
from mi_nerfattack.robot.tracker.replay import ReplayTracker, read_body_track
from mi_nerfattack.robot.tracker.vicon import PORT, ViconTracker

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
    kind, _, rest = text.partition(":")
    if kind == "vicon":
        host, port = _host_and_port(text, rest)
        return ViconTracker(host, port, convention, sender, clock)
    if kind == "motioncapture":
        system, _, host = rest.partition(":")
        if not system or not (host or system == "mock"):
            raise InputError(
                f"tracker {text!r}: must be motioncapture:KIND:HOST; kinds are "
                f"{', '.join(KINDS)}"
            )
        return MotionCaptureTracker(system, host, clock=clock)
    if kind == "replay" and rest:
        return ReplayTracker(read_body_track(Path(rest), mount), clock)
    raise InputError(f"tracker {text!r}: must be {FORMS}")


def _host_and_port(text: str, rest: str) -> tuple[str, int]:
    host, colon, port = rest.partition(":")
    if not host or (colon and not (port.isascii() and port.isdigit())):
        raise InputError(f"tracker {text!r}: must be vicon:HOST or vicon:HOST:PORT")
    return host, int(port) if colon else PORT
