"""The claim on a run folder, made before anything that takes long is imported."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import locks

#: The scenario of a run, its paths absolute.
SCENARIO = "scenario.toml"
#: What it was doing, what it has cost, and the folders of finished drives and
#: of judged random looks.
CHECKPOINT, EFFORT = "checkpoint.safetensors", "effort.safetensors"
DRIVES, LOOKS = "drives", "looks"


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make a run folder and keep other processes out of it, see `locks.claimed`.

    Raises:
        InputError: as of `locks.claimed`, or it holds something else than a run.
    """
    with locks.claimed(folder):
        present = {p.name for p in folder.iterdir() if not locks.is_partial(p)}
        is_run = SCENARIO in present and present & {EFFORT, CHECKPOINT, DRIVES}
        if not (is_run or present <= {SCENARIO}):  # a run that was killed at once
            raise InputError(
                f"{folder}: holds something else than a run; choose another folder"
            )
        yield
