"""Folders that one process at a time works in, and what a killed one left there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

try:
    import fcntl
except ImportError:  # not on Windows, which has no such locks
    fcntl = None


@contextmanager
def exclusive(folder: str | Path) -> Iterator[int | None]:
    """Keep other processes of this program out of a folder.

    The lock ends with the process, however it ends, and leaves no file. Where the
    file system or platform has no locks, nothing is kept out. A process that inherits
    what is yielded keeps the lock, too.

    Args:
        folder: must exist.

    Yields:
        the descriptor that has the lock; None where there are no locks.

    Raises:
        InputError: another process works in the folder, or it may not be read.
    """
    if fcntl is None:
        yield None
        return
    with files.reported(folder):
        descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as err:
            raise InputError(
                f"{folder}: another process works in it; wait for it or end it"
            ) from err
        except OSError:  # some network file systems: work without, as on Windows
            pass
        yield descriptor
    finally:
        os.close(descriptor)


@contextmanager
def claimed(folder: Path, remedy: str | None = None) -> Iterator[None]:
    """Make a folder and keep other processes out of it.

    At the end it is removed, with the parents that were made, if nothing was written.

    Args:
        folder: may be missing.
        remedy: what to do where it is not empty; None where it may hold anything.

    Raises:
        InputError: the folder cannot be made, another process works in it, or it holds
            what it may not.
    """
    made = [path for path in (folder, *folder.parents) if not os.path.exists(path)]
    files.make_folder(folder)
    with exclusive(folder):
        if remedy is not None and any(folder.iterdir()):
            raise InputError(f"{folder}: exists and is not an empty folder; {remedy}")
        try:
            yield
        finally:
            with suppress(OSError):  # one that is not empty stays, and so its parents
                for path in made:
                    path.rmdir()


def wait_for(folder: str | Path) -> None:
    """Wait until no process works in a folder, which may be missing.

    Raises:
        InputError: it may not be read.
    """
    if fcntl is None or not os.path.isdir(folder):
        return
    with files.reported(folder):
        descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # as of `exclusive`
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    finally:
        os.close(descriptor)


def remove_partial(folder: str | Path) -> list[Path]:
    """Remove what killed writers left in a folder and in the folders inside it.

    Call it only where no other process writes, see :func:`exclusive`.

    Returns:
        the files that were removed.
    """
    paths = [path for path in Path(folder).rglob(".*.tmp") if is_partial(path)]
    for path in paths:
        path.unlink(missing_ok=True)
    return paths


def is_partial(path: Path) -> bool:
    """Tell the temporary file of a killed writer, see :mod:`files`."""
    return files.TEMPORARY.fullmatch(path.name) is not None and path.is_file()
