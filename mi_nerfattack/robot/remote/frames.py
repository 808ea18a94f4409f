"""Bodies of the messages between a car and its policy."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass

import numpy as np
from PIL import Image

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.robot.devices import Frame

_FRAME = struct.Struct(">qddIIB")
_DECISION = struct.Struct(">qdddd")
PING = struct.Struct(">d")
PONG = struct.Struct(">ddd")
_RAW, _JPEG = 0, 1
#: Of a frame; its message stays below the largest that is looked at.
MAX_PIXELS = 1 << 24


@dataclass(frozen=True, eq=False)
class SentFrame:
    """A frame as it arrives.

    Attributes:
        index: of the frame.
        time_s: when it was taken, by the car's clock.
        ahead_s: by how much the server's clock is ahead, as the car knows it.
        shape: height and width.
        is_jpeg: whether it is compressed.
        data: of the image.
    """

    index: int
    time_s: float
    ahead_s: float
    shape: tuple[int, int]
    is_jpeg: bool
    data: bytes

    def decode(self) -> Frame:
        """Return the frame, its time by the server's clock.

        Raises:
            InputError: the image is damaged, or of another size than it says.
        """
        where = f"frame {self.index}"
        height, width = self.shape
        if self.is_jpeg:
            image = files.decode_image(where, self.data)
            if image.shape != (height, width, 3):
                raise InputError(
                    f"{where}: {image.shape}, said to be {height} x {width}"
                )
        elif len(self.data) == 3 * height * width > 0:
            image = np.frombuffer(self.data, np.uint8).reshape(height, width, 3)
        else:
            raise InputError(
                f"{where}: {len(self.data)} bytes, said to be {height} x {width} px"
            )
        return Frame(image, self.time_s + self.ahead_s, self.index)


@dataclass(frozen=True)
class SentDecision:
    """A decision as it arrives.

    Attributes:
        control: of the policy.
        index: of the frame.
        time_s: of the frame, by the car's clock.
        received_s: when the frame was there, by the server's clock.
        decided_s: when the decision was there, likewise.
    """

    control: float
    index: int
    time_s: float
    received_s: float
    decided_s: float

    def pack(self) -> bytes:
        """Return the body of its message."""
        return _DECISION.pack(
            self.index, self.control, self.time_s, self.received_s, self.decided_s
        )

    @classmethod
    def unpack(cls, body: bytes) -> SentDecision:
        """Read the body of a message; raises struct.error where it is none."""
        index, control, *times = _DECISION.unpack(body)
        return cls(control, index, *times)


def check_frame(frame: Frame) -> None:
    """Raise `InputError` unless a frame is one that can be sent."""
    image = frame.image
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise InputError(
            f"frame {frame.index}: {image.dtype} {image.shape}; needs uint8 (height, "
            "width, 3)"
        )
    if not 0 < image.size <= MAX_PIXELS * 3:
        raise InputError(
            f"frame {frame.index}: {image.shape[1]} x {image.shape[0]} px; from 1 to "
            f"{MAX_PIXELS} pixels are sent"
        )


def pack_frame(frame: Frame, ahead_s: float, jpeg_quality: int | None) -> bytes:
    """Return the body of a frame's message.

    Args:
        frame: one that `check_frame` lets pass.
        ahead_s: by how much the server's clock is ahead.
        jpeg_quality: 1 to 95; None sends the pixels as they are.
    """
    height, width = frame.image.shape[:2]
    if jpeg_quality is None:
        data, code = frame.image.tobytes(), _RAW
    else:
        buffer = io.BytesIO()
        Image.fromarray(frame.image).save(buffer, "JPEG", quality=jpeg_quality)
        data, code = buffer.getvalue(), _JPEG
    about = frame.index, frame.time_s, ahead_s, height, width, code
    return _FRAME.pack(*about) + data


def unpack_frame(body: bytes) -> SentFrame:
    """Read the body of a frame's message; raises struct.error where it is none."""
    index, time_s, ahead_s, height, width, code = _FRAME.unpack_from(body)
    shape, data = (height, width), body[_FRAME.size :]
    return SentFrame(index, time_s, ahead_s, shape, code == _JPEG, data)
