"""The claim on a run folder, made before anything that takes long is imported."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from mi_nerfattack.io import locks

_REMEDY = (
    "choose another, or continue the run in it with 'mi-nerfattack attack --resume'"
)


def claimed(folder: Path, resume: bool) -> AbstractContextManager[None]:
    """Make a run folder and keep other processes out of it, see `locks.claimed`.

    Args:
        folder: may be missing.
        resume: whether a run may be in it.
    """
    return locks.claimed(folder, None if resume else _REMEDY)
