"""A joystick with one button, by the bytes of Linux's driver in a FIFO."""

from __future__ import annotations

import os
import struct
from pathlib import Path


class Pad:
    """A joystick with one button, number 5."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self._end = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def press(self, is_down: bool) -> None:
        os.write(self._end, struct.pack("<IhBB", 0, int(is_down), 1, 5))

    def close(self) -> None:
        os.close(self._end)
