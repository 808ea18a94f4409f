"""ROS 2 messages of MCAP logs: definitions, decoders, and the topics of a log.

Definitions are those of ROS 2 Humble and later, and a few of our own
(`nerfattack_msgs`). A log carries the definitions of its messages, which are not read:
messages are decoded by the definitions here, so a log of somebody else cannot define
messages without an end.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files

MAX_LOG_BYTES = 1 << 32
MAX_CHUNK_BYTES = 1 << 30
_MAGIC = b"\x89MCAP0\r\n"
_HEAD, _FOOTER = struct.Struct("<BQ"), 2  # of a record; the kind of the last one

_HEADER = "std_msgs/Header header\n"
_FIELDS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\n"
    "geometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseStamped": f"{_HEADER}geometry_msgs/Pose pose\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\n"
    "float64[36] covariance\n",
    "geometry_msgs/PoseWithCovarianceStamped": f"{_HEADER}"
    "geometry_msgs/PoseWithCovariance pose\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\n"
    "geometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\n"
    "float64[36] covariance\n",
    "nav_msgs/Odometry": f"{_HEADER}string child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
    "sensor_msgs/CompressedImage": f"{_HEADER}string format\nuint8[] data\n",
    "sensor_msgs/Image": f"{_HEADER}uint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data\n",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\n"
    "uint32 width\nbool do_rectify\n",
    "sensor_msgs/CameraInfo": f"{_HEADER}uint32 height\nuint32 width\n"
    "string distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n"
    "uint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
    "ackermann_msgs/AckermannDrive": "float32 steering_angle\n"
    "float32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\n"
    "float32 jerk\n",
    "ackermann_msgs/AckermannDriveStamped": f"{_HEADER}"
    "ackermann_msgs/AckermannDrive drive\n",
    "rcl_interfaces/Log": "builtin_interfaces/Time stamp\nuint8 level\nstring name\n"
    "string msg\nstring file\nstring function\nuint32 line\n",
    "nerfattack_msgs/Decision": f"{_HEADER}float64 time_s\nint64 frame_index\n"
    "float64 frame_time_s\nfloat64 decided_s\nfloat64 control\n"
    "float64 asked_speed_ms\nfloat64 asked_steering_rad\nbool brake\n",
    "nerfattack_msgs/Motor": f"{_HEADER}float64 time_s\nfloat64 speed_ms\n"
    "float64 motor_current_a\nfloat64 input_voltage_v\n"
    "float64 fet_temperature_c\nint64 fault\n"
    "string fault_name\nint8 has_timed_out\nint8 is_killed\n",
    "nerfattack_msgs/Ages": f"{_HEADER}float64 time_s\nfloat64 frame_s\n"
    "float64 pose_s\nfloat64 decision_s\nfloat64 loop_s\n",
}


def full_name(kind: str) -> str:
    """Return ``PACKAGE/msg/NAME`` of ``PACKAGE/NAME``."""
    return "/msg/".join(kind.split("/"))


#: ``PACKAGE/msg/NAME`` of all messages that can be decoded.
KNOWN = frozenset(full_name(kind) for kind in _FIELDS)


def definition(kind: str) -> str:
    """Return a message's definition with those of its parts, as a log holds it.

    Args:
        kind: ``PACKAGE/NAME``.
    """
    kinds, text = [kind], _FIELDS[kind]
    for part in kinds:  # grows
        for line in _FIELDS[part].splitlines():
            name = line.split()[0].split("[")[0]
            if name in _FIELDS and name not in kinds:
                kinds.append(name)
                text += f"{'=' * 80}\nMSG: {name}\n{_FIELDS[name]}"
    return text


@cache
def decoder(name: str) -> Callable[[bytes], Any]:
    """Return what decodes the messages ``PACKAGE/msg/NAME``, in CDR.

    Raises:
        SetupError: the package mcap-ros2-support is not installed.
    """
    library = load_extra("mcap_ros2.decoder", "a log of ROS 2 messages")
    records = load_extra("mcap.records", "a log of ROS 2 messages")
    text = definition(name.replace("/msg/", "/"))
    schema = records.Schema(
        id=1, name=name, encoding="ros2msg", data=text.encode("ascii")
    )
    return library.DecoderFactory().decoder_for("cdr", schema)


@dataclass(frozen=True)
class Topic:
    """Messages of one topic of a log.

    Attributes:
        where: file and topic, for messages of ours.
        name: of the topic.
        kind: ``PACKAGE/msg/NAME``.
        raw: their bytes, in the order of the log.
    """

    where: str
    name: str
    kind: str
    raw: list[bytes]

    def decode(self) -> list[Any]:
        """Return the messages.

        Raises:
            InputError: one is damaged.
        """
        messages = []
        for index, data in enumerate(self.raw):
            try:
                messages.append(decoder(self.kind)(data))
            except (struct.error, ValueError, IndexError, OverflowError) as error:
                raise InputError(
                    f"{self.where}: message {index} is no {self.kind} ({error})"
                ) from error
        return messages


def read_topics(path: Path) -> tuple[dict[str, Topic], tuple[str, ...]]:
    """Return the topics of a log that can be decoded, by name, and remarks.

    Raises:
        InputError: it cannot be read, or has other messages alone.
    """
    try:
        McapError = load_extra("mcap.exceptions", "an MCAP log").McapError
        decoder("sensor_msgs/msg/Image")
    except SetupError as error:
        raise InputError(f"{path}: {error}") from error
    raw, remarks = _ended(files.read_bytes(path, MAX_LOG_BYTES))
    topics: dict[str, Topic] = {}
    others: set[str] = set()
    try:
        for topic, schema, encoding, data in _messages(path, raw):
            if encoding != "cdr" or schema not in KNOWN:
                others.add(f"{topic} has {schema!r} in {encoding!r}")
                continue
            where = f"{path}: {topic}"
            topics.setdefault(topic, Topic(where, topic, schema, raw=[])).raw.append(
                data
            )
    except InputError:
        raise
    except (McapError, struct.error, ValueError, KeyError, OverflowError) as error:
        raise InputError(
            f"{path}: damaged log ({type(error).__name__}: {error}); copy it again, or "
            "repair it with 'mcap recover'"
        ) from error
    if others and not topics:
        raise InputError(
            f"{path}: {', '.join(sorted(others)[:5])}; only ROS 2 messages in CDR are "
            "read"
        )
    return topics, remarks


def _ended(raw: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return a log with an end: one that is cut off ends after its last whole record.

    A record is a byte of its kind, 8 of its length, and as many as that.
    """
    if raw.endswith(_MAGIC) and len(raw) > len(_MAGIC):
        return raw, ()
    record_end, end = len(_MAGIC), len(_MAGIC)
    while end + _HEAD.size <= len(raw):
        kind, size = _HEAD.unpack_from(raw, end)
        end += _HEAD.size + size
        if end > len(raw) or kind == _FOOTER:
            break
        record_end = end
    remark = f"cut off; {record_end} of {len(raw)} bytes are read"
    return raw[:record_end] + _HEAD.pack(_FOOTER, 20) + bytes(20) + _MAGIC, (remark,)


def _messages(path: Path, raw: bytes) -> Iterator[tuple[str, str, str, bytes]]:
    """Yield topic, schema, encoding and data of all messages."""
    kinds = load_extra("mcap.records", "an MCAP log")
    library = load_extra("mcap.stream_reader", "an MCAP log")
    channels: dict[int, Any] = {}
    schemas: dict[int, str] = {0: ""}
    reader = library.StreamReader(
        io.BytesIO(raw), emit_chunks=True, record_size_limit=len(raw)
    )
    for outer in reader.records:
        is_chunk = isinstance(outer, kinds.Chunk)
        inner = _inflated(path, outer) if is_chunk else outer
        chunk = library.breakup_chunk(inner, True) if is_chunk else [outer]
        for record in chunk:
            if isinstance(record, kinds.Schema):
                schemas[record.id] = record.name
            elif isinstance(record, kinds.Channel):
                channels[record.id] = record
            elif isinstance(record, kinds.Message):
                channel = channels[record.channel_id]
                schema = schemas[channel.schema_id]
                yield channel.topic, schema, channel.message_encoding, record.data


def _inflated(path: Path, chunk: Any) -> Any:
    """Decompress a chunk to just the size that it announces."""
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
    zstandard = load_extra("zstandard", "a log compressed by zstd")
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            return reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error


def _unlz4(data: bytes, size: int) -> bytes:
    frame = load_extra("lz4.frame", "a log compressed by lz4")
    try:
        return frame.LZ4FrameDecompressor().decompress(data, size + 1)
    except (RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from error
