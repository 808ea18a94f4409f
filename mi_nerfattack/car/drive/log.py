"""The log of a drive: an MCAP file of ROS 2 messages, whole up to where it is cut off.

`TOPICS` names the messages; `deploy.replay.mcap` reads frames and poses. The stamp and
the time of publishing of a message say when its content was measured or sent; the log
time says when the message was written. All times come from the host's monotonic clock.
One offset turns them into wall time; the metadata `clocks` hold it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_nerfattack.car.devices import (
    Clock,
    Command,
    Decision,
    Frame,
    MotorValues,
    TrackedPose,
)
from mi_nerfattack.car.drive.safety.judge import Cause, Stop
from mi_nerfattack.deploy.replay.ros2 import definition, full_name
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io.growing import GrowingFile
from mi_nerfattack.render.camera.intrinsics import Camera, planar_state
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True)
class Figures:
    """Figures of a drive.

    Attributes:
        commands: number of commands that the loop sent.
        duration_s: from the first command to the last.
        laps: laps of a closed route; of an open route, shares of its length.
        largest_error_m: largest absolute cross-track error.
        mean_error_m: mean absolute cross-track error.
        period_s: mean time between commands.
        period_jitter_s: standard deviation of the time between commands.
        longest_period_s: longest time between two commands.
        latency_median_s: median time from a frame to its command.
        latency_99_s: 99th percentile of the time from a frame to its command.
    """

    commands: int
    duration_s: float
    laps: float
    largest_error_m: float
    mean_error_m: float
    period_s: float
    period_jitter_s: float
    longest_period_s: float
    latency_median_s: float
    latency_99_s: float


@dataclass
class Measures:
    """One row per command: its time, its frame's time, and the pose of the car."""

    rows: list[tuple[float, float, float, float, float]] = field(default_factory=list)

    def add(self, sent_s: float, decision: Decision, pose: TrackedPose) -> None:
        """Note a command."""
        x, y, heading = planar_state(pose.body_to_world).tolist()
        self.rows.append((sent_s, decision.frame_time_s, x, y, heading))

    def figures(self, route: Route) -> Figures | None:
        """Measure the drive; None of fewer than two commands."""
        if len(self.rows) < 2:
            return None
        rows = np.array(self.rows)
        sent, latency, states = rows[:, 0], rows[:, 0] - rows[:, 1], rows[:, 2:]
        arc, error, _ = route.project_numpy(states)
        steps = np.diff(arc)
        if route.closed:
            steps = (steps + 0.5 * route.length) % route.length - 0.5 * route.length
        period = np.diff(sent)
        return Figures(
            commands=len(rows),
            duration_s=float(sent[-1] - sent[0]),
            laps=float(steps.sum() / route.length),
            largest_error_m=float(np.abs(error).max()),
            mean_error_m=float(np.abs(error).mean()),
            period_s=float(period.mean()),
            period_jitter_s=float(period.std()),
            longest_period_s=float(period.max()),
            latency_median_s=float(np.median(latency)),
            latency_99_s=float(np.percentile(latency, 99)),
        )


#: Message and frame of each topic; `..._s` are seconds of the host's monotonic clock.
TOPICS: dict[str, tuple[str, str]] = {
    "/camera/image": ("sensor_msgs/CompressedImage", "camera"),
    "/camera/camera_info": ("sensor_msgs/CameraInfo", "camera"),
    "/vehicle/pose": ("geometry_msgs/PoseStamped", "world"),
    "/command": ("ackermann_msgs/AckermannDriveStamped", "vehicle"),
    "/decision": ("nerfattack_msgs/Decision", "vehicle"),
    "/motor": ("nerfattack_msgs/Motor", "vehicle"),
    "/ages": ("nerfattack_msgs/Ages", "vehicle"),
    "/safety": ("rcl_interfaces/Log", ""),
}
#: Levels of `rcl_interfaces/Log`.
INFO, WARNING, FATAL = 20, 30, 50
_JPEG_QUALITY = 95
_CHUNK_BYTES = 4096  # an image and the poses until the next: what a kill may cost


class DriveLog:
    """Writes what happens.

    Args:
        path: of a file that is not there.
        camera: intrinsics of the frames.
        clock: of the loop.
        wall_ns: wall time at this moment, nanoseconds since 1970.
        description: of the drive: texts by name.

    Attributes:
        counts: messages written, by topic.

    Raises:
        InputError: the file cannot be made.
        SetupError: the package mcap-ros2-support is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        camera: Camera,
        clock: Clock,
        wall_ns: int,
        description: Mapping[str, str],
    ) -> None:
        library = load_extra("mcap_ros2.writer", "the log of a drive")
        kinds = load_extra("mcap.writer", "the log of a drive").CompressionType
        self._clock, self._start_s, self._wall_ns = clock, clock(), wall_ns
        self._is_open, self.counts = True, dict.fromkeys(TOPICS, 0)
        self._file = GrowingFile(path)
        self._writer: Any = library.Writer(self._file, _CHUNK_BYTES, kinds.NONE)
        self._schemas = {
            topic: self._writer.register_msgdef(full_name(kind), definition(kind))
            for topic, (kind, _) in TOPICS.items()
        }
        clocks = {"monotonic_s": repr(self._start_s), "wall_ns": str(wall_ns)}
        self._writer.add_metadata("clocks", clocks)
        self._writer.add_metadata("drive", dict(description))
        self._add("/camera/camera_info", clock(), _camera_info(camera))

    def frame(self, frame: Frame) -> None:
        """Write an image, as JPEG."""
        buffer = io.BytesIO()
        Image.fromarray(frame.image).save(buffer, "JPEG", quality=_JPEG_QUALITY)
        message = {"format": "jpeg", "data": buffer.getvalue()}
        self._add("/camera/image", frame.time_s, message)

    def pose(self, pose: TrackedPose) -> None:
        """Write a pose."""
        matrix = pose.body_to_world
        turn = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
        place = {
            "position": dict(zip("xyz", matrix[:3, 3].tolist(), strict=True)),
            "orientation": dict(zip("xyzw", turn, strict=True)),
        }
        self._add("/vehicle/pose", pose.time_s, {"pose": place})

    def command(
        self, time_s: float, decision: Decision, request: Command, sent: Command
    ) -> None:
        """Write what was asked for and what was sent."""
        made = {
            "frame_index": decision.frame_index,
            "frame_time_s": decision.frame_time_s,
            "decided_s": decision.time_s,
            "control": decision.control,
        }
        self._command(time_s, made, request, sent=sent, brake=False)

    def brake(self, time_s: float) -> None:
        """Write that the car was braked and its wheels centred."""
        still, none = Command(0.0, 0.0), math.nan
        made = {"frame_index": -1, "frame_time_s": none, "decided_s": none}
        self._command(time_s, {**made, "control": none}, still, sent=still, brake=True)

    def _command(
        self,
        time_s: float,
        made: dict[str, Any],
        request: Command,
        sent: Command,
        brake: bool,
    ) -> None:
        drive = {"steering_angle": sent.steering_rad, "speed": sent.speed_ms}
        unused = dict.fromkeys(("steering_angle_velocity", "acceleration", "jerk"), 0.0)
        self._add("/command", time_s, {"drive": drive | unused})
        asked = {
            "asked_speed_ms": request.speed_ms,
            "asked_steering_rad": request.steering_rad,
        }
        self._add("/decision", time_s, {**made, **asked, "brake": brake})

    def motor(self, values: MotorValues) -> None:
        """Write what the motor controller says; NaN and -1 where it says nothing."""
        said = dict(vars(values))
        for name in (
            "speed_ms",
            "motor_current_a",
            "input_voltage_v",
            "fet_temperature_c",
        ):
            said[name] = math.nan if said[name] is None else said[name]
        for name in ("has_timed_out", "is_killed"):
            said[name] = -1 if said[name] is None else int(said[name])
        self._add("/motor", values.time_s, said)

    def ages(self, time_s: float, **ages_s: float) -> None:
        """Write how old frame, pose, decision and round were."""
        self._add("/ages", time_s, ages_s)

    def say(self, level: int, name: str, message: str) -> None:
        """Write a remark."""
        place = {"file": "", "function": "", "line": 0}
        remark = {"level": level, "name": name, "msg": message, **place}
        self._add("/safety", self._clock(), remark)

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

    def _add(self, topic: str, time_s: float, message: Mapping[str, Any]) -> None:
        if not self._is_open:
            return
        sec, nanosec = divmod(self._nanoseconds(time_s), 10**9)
        stamp = {"sec": sec, "nanosec": nanosec}
        header = {"stamp": stamp, "frame_id": TOPICS[topic][1]}
        try:
            self._writer.write_message(
                topic,
                self._schemas[topic],
                {"header": header, "stamp": stamp, "time_s": time_s, **message},
                log_time=self._nanoseconds(self._clock()),
                publish_time=self._nanoseconds(time_s),
                sequence=self.counts[topic],
            )
        except InputError as error:
            self._is_open = False
            raise Stop(Cause.LOG_FAILED, str(error)) from error
        self.counts[topic] += 1

    def _nanoseconds(self, time_s: float) -> int:
        """Return wall time of the monotonic clock."""
        return self._wall_ns + round((time_s - self._start_s) * 1e9)


def _camera_info(camera: Camera) -> dict[str, Any]:
    """Return intrinsics, of which ROS counts from the first pixel's centre."""
    x, y = camera.cx - 0.5, camera.cy - 0.5
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
    return {
        "width": int(camera.width),
        "height": int(camera.height),
        "distortion_model": "equidistant" if camera.is_fisheye else "plumb_bob",
        "d": [*camera.distortion[:4], *([] if camera.is_fisheye else [0.0])],
        "k": [camera.fx, 0.0, x, 0.0, camera.fy, y, 0.0, 0.0, 1.0],
        "r": np.eye(3).ravel().tolist(),
        "p": [camera.fx, 0.0, x, 0.0, 0.0, camera.fy, y, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {**region, "do_rectify": False},
    }
