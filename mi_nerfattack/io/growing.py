"""A new file that grows while it is written, whole up to its last piece."""

from __future__ import annotations

import os
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files


class GrowingFile:
    """A file that hands its data to the system at once: a killed process loses none.

    Unlike all other files, it is written under its name from the start, not first
    under a temporary name.

    Args:
        path: where no file exists yet; its folder is made.

    Raises:
        InputError: the file exists, or cannot be made or written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        files.make_folder(self.path.parent)
        if os.path.lexists(path):
            raise InputError(f"{path}: exists; choose another name")
        with files.reported(path):
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            self._descriptor = os.open(path, flags, 0o666)
        self._size, self._closed = 0, False

    def write(self, data: bytes) -> int:
        """Append bytes, all of them."""
        view = memoryview(data)
        with files.reported(self.path):
            while view:
                written = os.write(self._descriptor, view)
                self._size += written
                view = view[written:]
        return len(data)

    def flush(self) -> None:
        """Nothing is kept back."""

    def tell(self) -> int:
        """Return the bytes written so far."""
        return self._size

    def close(self) -> None:
        """Bring it to the disk and close it; more than once does no harm."""
        if self._closed:
            return
        self._closed = True
        try:
            with files.reported(self.path):
                os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)

    def discard(self) -> None:
        """Close it and remove it."""
        try:
            self.close()
        finally:
            with files.reported(self.path):
                self.path.unlink(missing_ok=True)
