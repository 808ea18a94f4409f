"""The log of a drive: an MCAP file that is whole up to where it is cut off.

Its topics are those of `messages.TOPICS`; `deploy.replay.mcap` reads frames and poses.
A message's time of publishing is when the thing was measured or sent, its log time when
it was written: both by the host's monotonic clock, turned to wall time by one offset,
which the metadata `clocks` hold.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.growing import GrowingFile
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.robot.devices import (
    Clock,
    Command,
    Decision,
    Frame,
    MotorValues,
    TrackedPose,
)
from mi_nerfattack.robot.drive import messages
from mi_nerfattack.robot.drive.safety.judge import Cause, Stop
from mi_nerfattack.system.extras import load_extra

_WRITE_EVERY_S = 0.5


class DriveLog:
    """Writes what happens.

    Args:
        path: of a file that is not there.
        camera: intrinsics of the frames.
        clock: of the loop.
        wall_ns: wall time at this moment, nanoseconds since 1970.
        about: of the drive: texts by name.

    Attributes:
        counts: messages written, by topic.

    Raises:
        InputError: the file cannot be made.
        SetupError: the package mcap is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        camera: Camera,
        clock: Clock,
        wall_ns: int,
        about: Mapping[str, str],
    ) -> None:
        mcap = load_extra("mcap.writer", "mcap", "the log of a drive")
        self._clock = clock
        self._wall = messages.WallClock(clock(), wall_ns)
        self._is_open, self._written_s = True, clock()
        self.counts = dict.fromkeys(messages.TOPICS, 0)
        self._file = GrowingFile(path)
        writer: Any = mcap.Writer(self._file)
        self._writer, self._channels = writer, {}
        writer.start(profile="", library="mi-nerfattack")
        for topic, (name, schema) in messages.TOPICS.items():
            text = json.dumps(schema).encode()
            number = writer.register_schema(name, "jsonschema", text)
            self._channels[topic] = writer.register_channel(topic, "json", number)
        clocks = {"monotonic_s": repr(self._wall.monotonic_s), "wall_ns": str(wall_ns)}
        writer.add_metadata("clocks", clocks)
        writer.add_metadata("drive", dict(about))
        self._add(
            "/camera/calibration", clock(), messages.calibration_message(camera), False
        )

    def frame(self, frame: Frame) -> None:
        """Write an image."""
        message = messages.image_message(frame.image)
        self._add("/camera/image", frame.time_s, message, False)

    def pose(self, pose: TrackedPose) -> None:
        """Write a pose."""
        message = messages.pose_message(pose.body_to_world)
        self._add("/vehicle/pose", pose.time_s, message, False)

    def command(
        self, time_s: float, decision: Decision, wanted: Command, sent: Command
    ) -> None:
        """Write what was asked for and what was sent."""
        message = messages.command_message(decision, wanted, sent)
        self._add("/command", time_s, message)

    def brake(self, time_s: float) -> None:
        """Write that the car was braked and its wheels centred."""
        still = Command(0.0, 0.0)
        message = messages.command_message(None, still, still, brake=True)
        self._add("/command", time_s, message)

    def motor(self, values: MotorValues) -> None:
        """Write what the motor controller says."""
        self._add("/motor", values.time_s, messages.motor_message(values))

    def ages(self, time_s: float, **ages_s: float) -> None:
        """Write how old frame, pose, decision and round were."""
        self._add("/ages", time_s, dict(ages_s))

    def say(self, level: int, name: str, message: str) -> None:
        """Write a remark."""
        found = messages.safety_message(level, name, message)
        self._add("/safety", self._clock(), found, False)

    def close(self) -> None:
        """End the file; more than once does no harm.

        Raises:
            InputError: it cannot be written.
        """
        try:
            if self._is_open:
                self._is_open = False  # whether or not the end can be written
                self._writer.finish()
        finally:
            self._file.close()

    def discard(self) -> None:
        """Remove the file: nothing was driven.

        Raises:
            InputError: it cannot be removed.
        """
        self._is_open = False
        self._file.discard()

    def _add(
        self, topic: str, time_s: float, message: dict[str, Any], own: bool = True
    ) -> None:
        if not self._is_open:
            return
        stamped = {"timestamp": self._wall.stamp(time_s), **message}
        if own:
            stamped["time_s"] = time_s
        now_s = self._clock()
        try:
            self._writer.add_message(
                self._channels[topic],
                log_time=self._wall.nanoseconds(now_s),
                data=json.dumps(stamped, allow_nan=False).encode(),
                publish_time=self._wall.nanoseconds(time_s),
                sequence=self.counts[topic],
            )
            if now_s - self._written_s >= _WRITE_EVERY_S:
                self._written_s = now_s
                self._writer.flush()
        except InputError as error:
            self._is_open = False
            raise Stop(Cause.LOG_FAILED, str(error)) from error
        self.counts[topic] += 1
