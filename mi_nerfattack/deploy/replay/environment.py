"""Recorded drives as a deployment environment, objects pasted by depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.deploy.car import Control
from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.replay.folder import FolderRecording
from mi_nerfattack.deploy.replay.mcap import McapRecording, McapTopics
from mi_nerfattack.deploy.replay.recording import AbstractRecording, vehicle_states
from mi_nerfattack.deploy.replay.video import VideoRecording
from mi_nerfattack.deploy.vehicle import Controls, checked_control
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.video import VIDEO_SUFFIXES
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.vehicle.route.route import Route


class ReplayEnvironment(AbstractEnvironment):
    """A recorded drive, in an open loop.

    The environment shows the recording: start pose, seed and controls have no effect,
    and `step` only notes the control. After each period comes the frame nearest in
    time. Objects are pasted by depth; where a recording has no depth, they are in front
    of everything.

    Args:
        recording: frames, times and poses; closed with the environment.
        mount: of the camera, from which the vehicle's pose follows.
        period: seconds between two frames.
        max_control: largest control of the policy; it has no effect.
        control_unit: of the control.
        more_controls: of the policy, after the first one.

    Attributes:
        controls: the controls of the policy since the last reset: one number per
            period, or (k,) of k > 1 controls.
    """

    name = "replay"

    def __init__(
        self,
        recording: AbstractRecording,
        mount: CameraMount,
        period: float = 0.1,
        max_control: float = 1.5,
        control_unit: str = "rad/s",
        more_controls: tuple[Control, ...] = (),
    ) -> None:
        if not 0 < period < math.inf:
            raise InputError(f"period: {period}; a positive time, seconds")
        self.recording, self.camera = recording, recording.camera
        self.rig = Rig.of_one(recording.camera, mount)
        self.period, self.max_control = period, max_control
        self.control_unit, self.more_controls = control_unit, more_controls
        self.controls: list[float | np.ndarray] = []
        self._states = vehicle_states(recording.track, mount)
        self._paster = Paster(self.camera, ())
        self._index = -1

    def reset(
        self, route: Route, pose: np.ndarray | None = None, seed: int = 0
    ) -> CameraFrame:
        """Go back to the first frame, whatever route, pose and seed are."""
        del route, pose, seed
        self.controls = []
        return self._show_frame()

    def step(self, control: Controls) -> CameraFrame:
        """Note the control and show the next frame.

        Raises:
            InputError: the control is not finite, nothing was reset before, or the
                recording is over.
        """
        if self._index < 0:
            raise InputError("environment 'replay': step comes after reset")
        values = checked_control(control, self.control_names)
        if self.is_over:
            raise InputError(
                f"{self.recording.track.where}: the recording is over after "
                f"{len(self.controls)} steps; reset goes back to its start"
            )
        self.controls.append(float(values[0]) if len(values) == 1 else values)
        return self._show_frame()

    @property
    def state(self) -> np.ndarray:
        """State (3,): x, y, heading of the vehicle that the frame was recorded from."""
        if self._index < 0:
            raise InputError("environment 'replay': it has a state only after reset")
        return self._states[self._index].copy()

    @property
    def speed(self) -> float:
        """Speed between the frames before and after, along the heading."""
        track, last = self.recording.track, len(self._states) - 1
        before, after = max(self._index - 1, 0), min(self._index + 1, last)
        if before == after:
            raise InputError(
                f"{track.where}: has one frame, and so no speed, which the policy "
                "takes; give a longer recording"
            )
        moved = self._states[after, :2] - self._states[before, :2]
        heading = self.state[2]
        along = moved @ np.array([math.cos(heading), math.sin(heading)])
        return float(along / (track.times[after] - track.times[before]))

    @property
    def is_over(self) -> bool:
        """Whether the next step would lie beyond the last frame."""
        end = float(self.recording.track.times[-1]) + 0.5 * self.period
        return self._time(len(self.controls) + 1) > end

    def show(self, objects: Sequence[Any]) -> None:
        """Paste fields by depth."""
        self._paster = Paster(self.camera, objects)

    def close(self) -> None:
        """Close the recording."""
        self.recording.close()

    def _time(self, step: int) -> float:
        return float(self.recording.track.times[0]) + step * self.period

    def _show_frame(self) -> CameraFrame:
        track = self.recording.track
        time = self._time(len(self.controls))
        self._index = int(np.argmin(abs(track.times - time)))
        frame = CameraFrame(
            self.recording.image(self._index),
            self.recording.depth(self._index),
            track.camera_to_world[self._index].copy(),
        )
        return self._paster.paste(frame)


def open_recording(
    path: str | Path,
    camera: Camera | None,
    mount: CameraMount,
    period: float = 0.1,
    topics: McapTopics | None = None,
) -> AbstractRecording:
    """Open a folder, a video or an MCAP log.

    Args:
        path: of it.
        camera: intrinsics, for recordings without their own.
        mount: of the camera, for poses of the vehicle.
        period: seconds between frames, for folders without times.
        topics: of an MCAP log.

    Raises:
        InputError: it is not there, of another kind, or cannot be read.
    """
    source = Path(path)
    with files.reported(source):
        is_folder = source.is_dir()
    if is_folder:
        return FolderRecording(source, camera, mount, period=period)
    suffix = source.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return VideoRecording(source, camera, mount)
    if suffix == ".mcap":
        return McapRecording(source, camera, mount, topics=topics)
    raise InputError(
        f"{source}: not a recording; give a folder, a video "
        f"({', '.join(VIDEO_SUFFIXES)}) or a log (.mcap)"
    )
