"""Recorded drives as MCAP logs of JSON messages in Foxglove's schemas.

====================  ============================  ===================================
topic (default)       schema                        used
====================  ============================  ===================================
`/camera/image`       `foxglove.CompressedImage`    `timestamp`, `data` (JPEG, PNG or
                                                    WebP in base64)
`/camera/pose`        `foxglove.PoseInFrame`        `timestamp`, `pose` of the camera,
                                                    OpenCV axes, in the world
or `/vehicle/pose`    `foxglove.PoseInFrame`        the same of the vehicle: x forward,
                                                    y left, z up
`/camera/calibration` `foxglove.CameraCalibration`  `width`, `height`, `K`, `D`
                                                    (`plumb_bob`); may be missing
====================  ============================  ===================================

A frame takes the pose nearest in time. There is no depth. A log that is cut off, as by
a process that was killed, is read up to there; frames before the first pose and after
the last are left out.
"""

from __future__ import annotations

import base64
import binascii
import io
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.pose_files import pose_matrix
from mi_nerfattack.deploy.replay.folder import required_camera
from mi_nerfattack.deploy.replay.recording import (
    AbstractRecording,
    Track,
    check_times,
    checked_image,
    nearest_pose,
    no_depth,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.strict_json import parse_json
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, camera_to_body
from mi_nerfattack.system.extras import install_hint

MAX_LOG_BYTES = 1 << 32
MAX_CHUNK_BYTES = 1 << 30
_MAGIC = b"\x89MCAP0\r\n"
_HEAD, _FOOTER = struct.Struct("<BQ"), 2  # of a record; the kind of the last one


@dataclass(frozen=True)
class McapTopics:
    """Names of the topics of a log; see the module.

    Args:
        image: of the frames.
        camera_pose: comes first where a log has both.
        vehicle_pose: combined with the camera's mount.
        calibration: of the camera.
    """

    image: str = "/camera/image"
    camera_pose: str = "/camera/pose"
    vehicle_pose: str = "/vehicle/pose"
    calibration: str = "/camera/calibration"

    def schemas(self) -> dict[str, str]:
        """Return the schema that each topic must have."""
        return {
            self.image: "foxglove.CompressedImage",
            self.camera_pose: "foxglove.PoseInFrame",
            self.vehicle_pose: "foxglove.PoseInFrame",
            self.calibration: "foxglove.CameraCalibration",
        }


class McapRecording(AbstractRecording):
    """An MCAP log; the images stay compressed until they are asked for.

    Args:
        path: of at most 4 GiB.
        camera: intrinsics, for logs without.
        mount: of the camera, for poses of the vehicle.
        topics: names.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera | None,
        mount: CameraMount,
        topics: McapTopics | None = None,
    ) -> None:
        topics = topics or McapTopics()
        found, self.remarks = _read_messages(path, topics.schemas())
        images = found[topics.image]
        if not images:
            cut = "".join(f" ({remark})" for remark in self.remarks)
            raise InputError(f"{path}: no message on {topics.image}, so no frame{cut}")
        self._path = path
        self._images = [_compressed(f"{path}: {topics.image}", item) for item in images]
        times = _stamps(f"{path}: {topics.image}", images)
        name, pose_times, poses = _camera_poses(path, found, topics, mount)
        kept = _with_poses(times, pose_times)
        if (kept.start, kept.stop) != (0, len(times)):
            self.remarks += (
                f"frames {kept.start} to {kept.stop - 1} of {len(times)} are read; "
                f"before and after them there are no poses on {name}",
            )
        times, self._images = times[kept], self._images[kept]
        index = nearest_pose(str(path), name, times, pose_times)
        self.track = Track(str(path), times, poses[index])
        own = _calibration(f"{path}: {topics.calibration}", found[topics.calibration])
        self.camera = required_camera(path, own, camera)

    def image(self, index: int) -> np.ndarray:
        """Decode one image."""
        where = f"{self._path}: frame {index}"
        image = files.decode_image(where, self._images[index])
        return checked_image(where, image, self.camera)

    def depth(self, index: int) -> np.ndarray:
        """Return infinite depth: a log has none."""
        return no_depth(self.camera)


def read_vehicle_poses(
    path: Path, mount: CameraMount, topics: McapTopics | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Read all poses of a log's vehicle, those between frames too.

    Args:
        path: of at most 4 GiB.
        mount: of the camera, for logs of its poses.
        topics: names.

    Returns:
        times (n,), seconds, and body to world (n, 4, 4): x forward, y left, z up,
        metres.

    Raises:
        InputError: it cannot be read, or has no poses.
    """
    topics = topics or McapTopics()
    schemas = topics.schemas()
    wanted = {name: schemas[name] for name in (topics.camera_pose, topics.vehicle_pose)}
    found, _ = _read_messages(path, wanted)
    _, times, poses = _camera_poses(path, found, topics, mount)
    return times, poses @ np.linalg.inv(camera_to_body(mount))


def _camera_poses(
    path: Path,
    found: Mapping[str, Sequence[Mapping[str, Any]]],
    topics: McapTopics,
    mount: CameraMount,
) -> tuple[str, np.ndarray, np.ndarray]:
    """Return the topic, times (n,) and poses (n, 4, 4) of the camera, OpenCV axes."""
    name, body_to_camera = topics.camera_pose, np.eye(4)
    if not found[name]:
        name, body_to_camera = topics.vehicle_pose, camera_to_body(mount)
    if not found[name]:
        raise InputError(
            f"{path}: no message on {topics.camera_pose} or {topics.vehicle_pose}; "
            "record the poses, too"
        )
    where = f"{path}: {name}"
    poses = np.stack([_pose(where, item) for item in found[name]]) @ body_to_camera
    return name, _stamps(where, found[name]), poses


def _read_messages(
    path: Path, schemas: Mapping[str, str]
) -> tuple[dict[str, list[dict[str, Any]]], tuple[str, ...]]:
    """Return the messages of each topic in the order of the log, and remarks."""
    try:
        from mcap.exceptions import McapError
    except ImportError as error:
        raise InputError(
            f"{path}: MCAP logs need the package mcap ({error}); {install_hint('mcap')}"
        ) from error
    raw, remarks = _ended(files.read_bytes(path, MAX_LOG_BYTES))
    found: dict[str, list[dict[str, Any]]] = {topic: [] for topic in schemas}
    try:
        for topic, schema, encoding, data in _messages(path, raw, found):
            wanted = schemas[topic]
            if schema != wanted or encoding != "json":
                raise InputError(
                    f"{path}: {topic} has {schema!r} messages in {encoding!r}; only "
                    f"{wanted} in JSON is read"
                )
            where = f"{path}: {topic}: message {len(found[topic])}"
            message = parse_json(where, data.decode("utf-8"))
            if not isinstance(message, dict):
                raise InputError(f"{where}: not an object")
            found[topic].append(message)
    except InputError:
        raise
    except (McapError, struct.error, ValueError, KeyError, OverflowError) as error:
        raise InputError(
            f"{path}: damaged log ({type(error).__name__}: {error}); copy it again, or "
            "repair it with 'mcap recover'"
        ) from error
    return found, remarks


def _ended(raw: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return a log with an end: one that is cut off ends after its last whole record.

    A record is a byte of its kind, 8 of its length, and as many as that.
    """
    if raw.endswith(_MAGIC) and len(raw) > len(_MAGIC):
        return raw, ()
    whole, end = len(_MAGIC), len(_MAGIC)
    while end + _HEAD.size <= len(raw):
        kind, size = _HEAD.unpack_from(raw, end)
        end += _HEAD.size + size
        if end > len(raw) or kind == _FOOTER:
            break
        whole = end
    remark = f"cut off; {whole} of {len(raw)} bytes are read"
    return raw[:whole] + _HEAD.pack(_FOOTER, 20) + bytes(20) + _MAGIC, (remark,)


def _with_poses(times: np.ndarray, pose_times: np.ndarray) -> slice:
    """Return the frames between the first pose and the last, half a frame beyond."""
    half = 0.5 * float(np.diff(times).min()) if len(times) > 1 else 0.05
    first = np.searchsorted(times, pose_times[0] - half)
    last = np.searchsorted(times, pose_times[-1] + half, side="right")
    return slice(int(first), int(last)) if first < last else slice(0, len(times))


def _messages(
    path: Path, raw: bytes, topics: Mapping[str, Any]
) -> Iterator[tuple[str, str, str, bytes]]:
    """Yield topic, schema, encoding and data of the messages on given topics."""
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk

    channels: dict[int, Any] = {}
    schemas: dict[int, str] = {0: ""}
    reader = StreamReader(io.BytesIO(raw), emit_chunks=True, record_size_limit=len(raw))
    for outer in reader.records:
        is_chunk = isinstance(outer, Chunk)
        chunk = breakup_chunk(_inflated(path, outer), True) if is_chunk else [outer]
        for record in chunk:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                if channel.topic in topics:
                    schema = schemas[channel.schema_id]
                    yield channel.topic, schema, channel.message_encoding, record.data


def _inflated(path: Path, chunk: Any) -> Any:
    """Decompress a chunk to just the size that it announces."""
    from dataclasses import replace

    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise InputError(
            f"{path}: a chunk of {size} bytes; at most {MAX_CHUNK_BYTES} are read"
        )
    if chunk.compression == "zstd":
        data = _unzstd(chunk.data, size)
    elif chunk.compression == "lz4":
        data = _unlz4(chunk.data, size)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise InputError(
            f"{path}: compression {chunk.compression!r}; only zstd and lz4 are read"
        )
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes that announces {size}")
    return replace(chunk, compression="", data=data)


def _unzstd(data: bytes, size: int) -> bytes:
    import zstandard

    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            return reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error


def _unlz4(data: bytes, size: int) -> bytes:
    import lz4.frame

    try:
        return lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
    except (RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from error


def _stamps(where: str, messages: Sequence[Mapping[str, Any]]) -> np.ndarray:
    times = []
    for index, message in enumerate(messages):
        stamp = message.get("timestamp")
        parts = (
            [stamp.get(k) for k in ("sec", "nsec")] if isinstance(stamp, dict) else []
        )
        if not parts or not all(type(part) is int for part in parts):
            raise InputError(
                f"{where}: message {index}: timestamp {stamp!r}; needs sec and nsec, "
                "whole numbers"
            )
        times.append(parts)
    # seconds since 1970 leave 0.2 microseconds of a float64
    seconds = np.array([sec + 1e-9 * nsec for sec, nsec in times])
    check_times(where, seconds)
    return seconds


def _compressed(where: str, message: Mapping[str, Any]) -> bytes:
    try:
        return base64.b64decode(message.get("data", ""), validate=True)
    except (TypeError, ValueError, binascii.Error) as error:
        raise InputError(f"{where}: data is not base64 ({error})") from error


def _pose(where: str, message: Mapping[str, Any]) -> np.ndarray:
    pose: Any = message.get("pose")
    try:
        position = [float(pose["position"][key]) for key in "xyz"]
        turn = [float(pose["orientation"][key]) for key in "wxyz"]
    except (TypeError, KeyError, ValueError) as error:
        raise InputError(
            f"{where}: pose {pose!r}; needs position x, y, z and orientation x, y, z, w"
        ) from error
    return pose_matrix(where, position, turn)


def _calibration(where: str, messages: Sequence[Mapping[str, Any]]) -> Camera | None:
    """Return the camera of the last calibration; None if there is none."""
    if not messages:
        return None
    message = messages[-1]
    model = message.get("distortion_model", "plumb_bob") or "plumb_bob"
    try:
        size = [int(message[key]) for key in ("width", "height")]
        k = np.array(message["K"], np.float64).reshape(3, 3)
        d = [*map(float, message.get("D") or []), 0.0, 0.0, 0.0, 0.0]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: needs width, height, K and D ({error})") from error
    if model != "plumb_bob" or any(d[4:]):
        raise InputError(
            f"{where}: distortion_model {model!r}, D {d[:-4]}; only plumb_bob with k1, "
            "k2, p1, p2 is read"
        )
    try:
        # counted from the centre of the first pixel there, from its corner here
        pinhole = map(float, (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5))
        return Camera(size[0], size[1], *pinhole, *d[:4])
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
