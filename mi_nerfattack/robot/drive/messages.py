"""Messages of a drive's log: Foxglove's schemas in JSON, and a few of our own."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.robot.devices import Command, Decision, MotorValues

_JPEG_QUALITY = 95
#: Levels of `foxglove.Log`.
INFO, WARNING, FATAL = 2, 3, 5

_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_MAYBE: dict[str, Any] = {"type": ["number", "null"]}
_WHOLE, _FLAG = {"type": "integer"}, {"type": "boolean"}
_NUMBERS = {"type": "array", "items": _NUMBER}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_TIME = _object(sec=_WHOLE, nsec=_WHOLE)
_PLACE = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_TURN = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_COMMAND = _object(speed_ms=_NUMBER, steering_rad=_NUMBER)

#: Schema's name and properties of each topic; times are also seconds of the host's
#: monotonic clock, `..._s`.
TOPICS: dict[str, tuple[str, dict[str, Any]]] = {
    "/camera/image": (
        "foxglove.CompressedImage",
        _object(
            timestamp=_TIME,
            frame_id=_TEXT,
            data={**_TEXT, "contentEncoding": "base64"},
            format=_TEXT,
        ),
    ),
    "/camera/calibration": (
        "foxglove.CameraCalibration",
        _object(
            timestamp=_TIME,
            frame_id=_TEXT,
            width=_WHOLE,
            height=_WHOLE,
            distortion_model=_TEXT,
            D=_NUMBERS,
            K=_NUMBERS,
            R=_NUMBERS,
            P=_NUMBERS,
        ),
    ),
    "/vehicle/pose": (
        "foxglove.PoseInFrame",
        _object(
            timestamp=_TIME,
            frame_id=_TEXT,
            pose=_object(position=_PLACE, orientation=_TURN),
        ),
    ),
    "/safety": (
        "foxglove.Log",
        _object(
            timestamp=_TIME,
            level=_WHOLE,
            message=_TEXT,
            name=_TEXT,
            file=_TEXT,
            line=_WHOLE,
        ),
    ),
    "/command": (
        "nerfattack.Command",
        _object(
            timestamp=_TIME,
            time_s=_NUMBER,
            frame_index=_WHOLE,
            frame_time_s=_NUMBER,
            decided_s=_NUMBER,
            control=_NUMBER,
            asked=_COMMAND,
            sent=_COMMAND,
            brake=_FLAG,
        ),
    ),
    "/motor": (
        "nerfattack.Motor",
        _object(
            timestamp=_TIME,
            time_s=_NUMBER,
            speed_ms=_MAYBE,
            motor_current_a=_MAYBE,
            input_voltage_v=_MAYBE,
            fault=_WHOLE,
            fault_name=_TEXT,
            has_timed_out={"type": ["boolean", "null"]},
            is_killed={"type": ["boolean", "null"]},
        ),
    ),
    "/ages": (
        "nerfattack.Ages",
        _object(
            timestamp=_TIME,
            time_s=_NUMBER,
            frame_s=_NUMBER,
            pose_s=_NUMBER,
            decision_s=_NUMBER,
            loop_s=_NUMBER,
        ),
    ),
}


@dataclass(frozen=True)
class WallClock:
    """Turns the host's monotonic clock to wall time, by one offset for a whole drive.

    Args:
        monotonic_s: a moment, by the one.
        wall_ns: the same by the other, nanoseconds since 1970.
    """

    monotonic_s: float
    wall_ns: int

    def nanoseconds(self, time_s: float) -> int:
        """Return wall time."""
        return self.wall_ns + round((time_s - self.monotonic_s) * 1e9)

    def stamp(self, time_s: float) -> dict[str, int]:
        """Return wall time as Foxglove's messages hold it."""
        sec, nsec = divmod(self.nanoseconds(time_s), 10**9)
        return {"sec": sec, "nsec": nsec}


def image_message(image: np.ndarray) -> dict[str, Any]:
    """Return an image (height, width, 3), uint8 sRGB, as JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=_JPEG_QUALITY)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return {"frame_id": "camera", "data": data, "format": "jpeg"}


def calibration_message(camera: Camera) -> dict[str, Any]:
    """Return intrinsics, of which Foxglove counts from the first pixel's centre."""
    x, y = camera.cx - 0.5, camera.cy - 0.5
    return {
        "frame_id": "camera",
        "width": int(camera.width),
        "height": int(camera.height),
        "distortion_model": "plumb_bob",
        "D": [*camera.distortion, 0.0],
        "K": [camera.fx, 0.0, x, 0.0, camera.fy, y, 0.0, 0.0, 1.0],
        "R": np.eye(3).ravel().tolist(),
        "P": [camera.fx, 0.0, x, 0.0, 0.0, camera.fy, y, 0.0, 0.0, 0.0, 1.0, 0.0],
    }


def pose_message(body_to_world: np.ndarray) -> dict[str, Any]:
    """Return a pose (4, 4)."""
    turn = Rotation.from_matrix(body_to_world[:3, :3]).as_quat().tolist()
    place = body_to_world[:3, 3].tolist()
    return {
        "frame_id": "world",
        "pose": {
            "position": dict(zip("xyz", place, strict=True)),
            "orientation": dict(zip("xyzw", turn, strict=True)),
        },
    }


def command_message(
    decision: Decision | None, wanted: Command, sent: Command, brake: bool = False
) -> dict[str, Any]:
    """Return what was asked for and what was sent; without a decision, for a brake."""
    made: dict[str, Any] = {}
    if decision is not None:
        made = {
            "frame_index": decision.frame_index,
            "frame_time_s": decision.frame_time_s,
            "decided_s": decision.time_s,
            "control": decision.control,
        }
    return {**made, "asked": vars(wanted), "sent": vars(sent), "brake": brake}


def motor_message(values: MotorValues) -> dict[str, Any]:
    """Return what a motor controller says of itself."""
    return dict(vars(values))


def safety_message(level: int, name: str, message: str) -> dict[str, Any]:
    """Return a remark: its level, what it is called, and for a person."""
    return {"level": level, "message": message, "name": name, "file": "", "line": 0}
