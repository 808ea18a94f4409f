"""The claim on a run folder, made before anything that takes long is imported."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files, locks


@contextmanager
def claimed(folder: Path, resume: bool) -> Iterator[None]:
    """Make a run folder and keep other processes out of it.

    At the end it is removed, with the parents that were made, if nothing was written.

    Args:
        folder: may be missing.
        resume: whether a run may be in it.

    Raises:
        InputError: the folder cannot be made, another process works in it, or, without
            `resume`, it is not empty.
    """
    made = [path for path in (folder, *folder.parents) if not os.path.exists(path)]
    files.make_folder(folder)
    with locks.exclusive(folder):
        if not resume and any(folder.iterdir()):
            raise InputError(
                f"{folder}: exists and is not an empty folder; choose another, or "
                "continue the run in it with 'mi-nerfattack attack --resume'"
            )
        try:
            yield
        finally:
            with suppress(OSError):  # one that is not empty stays, and so its parents
                for path in made:
                    path.rmdir()
