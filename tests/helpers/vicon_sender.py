"""VICON Tracker's UDP object stream, as Tracker sends it: a stand-in for Tracker.

Written from the description of the format alone; it shares nothing with the receiver.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence

#: Name, three millimetres, three radians.
Item = tuple[str, Sequence[float], Sequence[float]]
ITEM_BYTES, FIRST, NUMBERS = 75, 5, 27  # of an item; where the first, its numbers begin


def item_bytes(item: Item) -> bytes:
    name, position_mm, rotation_rad = item
    raw = struct.pack("<B", 0) + struct.pack("<H", 72) + name.encode().ljust(24, b"\0")
    for value in (*position_mm, *rotation_rad):
        raw += struct.pack("<d", value)
    return raw


def datagrams(
    frame: int, items: Sequence[Item], size: int = 256, padding: bytes = b"\0"
) -> list[bytes]:
    """Return the blocks of a frame: as many as it takes, at least one."""
    each, found = (size - 5) // 75, []
    for start in range(0, max(len(items), 1), each):
        held = items[start : start + each]
        raw = struct.pack("<I", frame) + struct.pack("<B", len(held))
        raw += b"".join(item_bytes(item) for item in held)
        found.append(raw + (padding * size)[: size - len(raw)])
    return found


class Sender:
    """Tracker's end of the stream."""

    def __init__(self, address: tuple[str, int], source: str = "127.0.0.1") -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((source, 0))
        self._address = address

    def send(self, raw: bytes) -> None:
        self._socket.sendto(raw, self._address)

    def close(self) -> None:
        self._socket.close()
