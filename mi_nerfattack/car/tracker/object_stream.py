"""VICON Tracker's UDP object stream: what a datagram says, and in which order.

Little endian, packed:

=======  =======  ==================================================
offset   type     field
=======  =======  ==================================================
0        u32      frame number
4        u8       items in this block
5        item     u8 kind, u16 size of its data, then the data:
+3       24 B     name, padded with zeros
+27      3 f64    position, millimetres
+51      3 f64    rotation, radians
=======  =======  ==================================================

Datagrams have one of three sizes, whatever they hold. A frame of more bodies than one
holds is sent as several blocks of one frame number. There is no checksum but UDP's.

Source: DataBlock.h in Vicon's Simulink sample (MathWorks File Exchange 51143), and
help.vicon.com, Tracker 4.2.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from mi_nerfattack.car.devices import TrackedPose
from mi_nerfattack.car.tracker.newest import MOST_BODIES, NewestPoses
from mi_nerfattack.errors import InputError

#: Meaning of the three numbers of a rotation, body to world: angles about the body's
#: own x, then y, then z axis (R = Rx Ry Rz), or axis times angle.
Convention = Literal["euler", "rotation-vector"]
CONVENTIONS: tuple[Convention, ...] = ("euler", "rotation-vector")

SIZES = (256, 512, 1024)  # bytes of a datagram
#: Silence after which a lower frame number is a new start of Tracker, no late datagram.
RESTART_S = 0.5
_BLOCK, _ITEM = struct.Struct("<IB"), struct.Struct("<BH")
_OBJECT = struct.Struct("<24s6d")
_OBJECT_KINDS = 0, 2  # by Vicon's manual; by what one receiver found
_LARGEST_MM, _LARGEST_RAD = 1e6, 6.3


@dataclass(frozen=True)
class Block:
    """What one datagram says.

    Args:
        frame: number.
        objects: position (3 values, mm) and rotation (3, radians) by name.
        refused: why others were left out, by name.
    """

    frame: int
    objects: Mapping[str, tuple[float, ...]]
    refused: Mapping[str, str]


def read_datagram(raw: bytes) -> Block:
    """Read a datagram.

    The function refuses an object whose numbers are not finite or are out of range. It
    also refuses an object whose position is zero, because Tracker sends zero for an
    object that it does not see. It ignores an item of another kind or size.

    Raises:
        InputError: the datagram is not part of the object stream.
    """
    if len(raw) not in SIZES:
        sizes = ", ".join(map(str, SIZES))
        raise InputError(f"a datagram of {len(raw)} bytes; Tracker sends {sizes}")
    frame, count = _BLOCK.unpack_from(raw)
    objects: dict[str, tuple[float, ...]] = {}
    refused: dict[str, str] = {}
    start = _BLOCK.size
    for index in range(count):
        data = start + _ITEM.size
        kind, size = _ITEM.unpack_from(raw, start) if data <= len(raw) else (0, 1 << 16)
        start = data + size
        if start > len(raw):
            raise InputError(f"item {index} of {count} ends beyond the datagram")
        if kind not in _OBJECT_KINDS or size != _OBJECT.size:
            continue
        field, *values = _OBJECT.unpack_from(raw, data)
        name = field.partition(b"\0")[0].decode("utf-8", "replace")
        if name in objects or name in refused:
            raise InputError(f"a datagram names {name!r} twice")
        if why := _refusal(np.array(values)):
            refused[name] = why
        else:
            objects[name] = tuple(values)
    return Block(frame, objects, refused)


def _refusal(values: np.ndarray) -> str:
    """Return why six numbers are no pose; empty if they are one."""
    largest = np.repeat([_LARGEST_MM, _LARGEST_RAD], 3)
    if not (abs(values) <= largest).all():  # nor NaN
        return f"its numbers {values.tolist()} are not finite, or beyond 1 km or 2 pi"
    return "" if values[:3].any() else "Tracker does not see it: its position is zero"


def to_rotation(rotation_rad: ArrayLike, convention: Convention) -> Rotation:
    """Return the rotation, body to world, that three numbers encode."""
    if convention == "euler":
        return Rotation.from_euler("XYZ", rotation_rad)
    return Rotation.from_rotvec(rotation_rad)


class ObjectStream:
    """The newest pose of each body in a stream of datagrams.

    Blocks of one frame have one time, that of the first. A frame older than one that
    came within `RESTART_S` is dropped.

    Args:
        convention: of the rotations.
    """

    def __init__(self, convention: Convention = "euler") -> None:
        if convention not in CONVENTIONS:
            raise InputError(
                f"rotation convention: {convention!r}; one of {', '.join(CONVENTIONS)}"
            )
        self._convention: Convention = convention
        self._frame, self._time_s = -1, -np.inf
        self._poses, self._rotations = NewestPoses(), dict[str, np.ndarray]()
        self._refused: dict[str, str] = {}
        self._error = ""

    def take(self, raw: bytes, time_s: float) -> bool:
        """Take a datagram.

        Args:
            raw: its bytes.
            time_s: when it came.

        Returns:
            Whether it is one of the object stream.
        """
        try:
            block = read_datagram(raw)
        except InputError as error:
            self._error = str(error)
            return False
        if block.frame < self._frame and time_s - self._time_s < RESTART_S:
            return True
        if block.frame != self._frame:
            self._frame, self._time_s = block.frame, time_s
        for name, values in block.objects.items():
            matrix = np.eye(4)
            matrix[:3, :3] = to_rotation(values[3:], self._convention).as_matrix()
            matrix[:3, 3] = 1e-3 * np.array(values[:3])
            if self._poses.update(name, matrix, self._time_s, self._frame):
                self._rotations[name] = np.array(values[3:])
            self._refused.pop(name, None)
        if len(self._refused) < MOST_BODIES:
            self._refused.update(block.refused)
        return True

    def newest(self, body: str) -> TrackedPose | None:
        """Return the newest pose of a body; None before the first."""
        return self._poses.newest(body)

    def rotation(self, body: str) -> np.ndarray | None:
        """Return the three numbers (3,), radians, that came last for a body."""
        return self._rotations.get(body)

    def explain(self, body: str) -> str:
        """Say why no new pose of a body comes; empty where nothing came at all."""
        if self._frame < 0:
            return f"what comes is no object stream: {self._error}" * bool(self._error)
        if body in self._refused:
            return f"{body!r}: {self._refused[body]}"
        return self._poses.explain(body, self._frame, "tick it in Tracker")
