"""Frames of a VESC's serial port: start, length, payload, checksum, stop.

Start byte 2 is followed by a length of one byte, 3 by one of two, high byte first; the
checksum is CRC-16/XMODEM of the payload, high byte first.

Source: VESC firmware, comm/packet.c and util/crc.c.
"""

from __future__ import annotations

import re
from binascii import crc_hqx

#: Longest payload that the firmware takes or sends, bytes.
LONGEST = 512

_SHORT, _LONG, _STOP = 2, 3, b"\x03"
_START = re.compile(b"[\x02\x03]")


def encode_frame(payload: bytes) -> bytes:
    """Wrap a payload of 1 to `LONGEST` bytes."""
    size = len(payload)
    assert 0 < size <= LONGEST, size
    if size < 256:
        head = bytes((_SHORT, size))
    else:
        head = bytes((_LONG,)) + size.to_bytes(2, "big")
    return head + payload + _tail(payload)


def _tail(payload: bytes) -> bytes:
    return crc_hqx(payload, 0).to_bytes(2, "big") + _STOP


class FrameDecoder:
    """Finds frames in bytes that come piece by piece, some of them damaged.

    Where no frame begins at a byte, that byte alone is dropped: a damaged frame takes
    no other with it. A damaged length can make it wait for as many bytes as the longest
    frame has, and no longer; `flush` ends that wait. It holds no more than that.
    """

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the payloads of the frames that are whole with these bytes."""
        self._held += data
        return self._take(is_over=False)

    def flush(self) -> list[bytes]:
        """Return the payloads behind a frame that never became whole.

        For a pause longer than any between two bytes of a frame.
        """
        return self._take(is_over=True)

    def _take(self, is_over: bool) -> list[bytes]:
        held, position, payloads = self._held, 0, []
        while match := _START.search(held, position):
            position = match.start()
            payload = _payload_at(held, position)
            if payload:
                payloads.append(payload)
                position += _head_size(held[position]) + len(payload) + 3
            elif payload is None and not is_over:
                break
            else:
                position += 1
        del held[: position if match else len(held)]
        return payloads


def _payload_at(held: bytearray, position: int) -> bytes | None:
    """Return the payload of a frame that begins here.

    Empty where none does, None where that takes more bytes to tell.
    """
    head = _head_size(held[position])
    begin = position + head
    if begin > len(held):
        return None
    size = int.from_bytes(held[position + 1 : begin], "big")
    if not (0 < size < 256 if head == 2 else 255 <= size <= LONGEST):
        return b""
    end = begin + size
    if end + 3 > len(held):
        return None
    payload = bytes(held[begin:end])
    return payload if held[end : end + 3] == _tail(payload) else b""


def _head_size(start: int) -> int:
    return 2 if start == _SHORT else 3
