"""The run folder of an attack: what is kept between its processes, and their cost."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.backend.determinism import random_states, restore_random_states
from mi_nerfattack.drives.store import Store
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.experiment.claim import CHECKPOINT, DRIVES, EFFORT, SCENARIO
from mi_nerfattack.io import files, locks
from mi_nerfattack.io.resumable import (
    Record,
    Unit,
    UnitContent,
    check_entries,
    misfits_reported,
)
from mi_nerfattack.system.machine import peak_memory_mb, peak_of_children_mb

CHECKPOINT_FORMAT = "mi_nerfattack attack checkpoint 10"
REMEDY = (
    "go on with the scenario.toml of the run folder and the same files and versions, "
    "start a new run folder, or ignore this (--force)"
)


class CheckpointRecord(Record):
    """Record of a checkpoint, without the state of the attack.

    It holds ignored differences and the findings of the checks before the attack.
    """

    ignored: list[str]
    flags: list[str] = []


class CheckpointFile:
    """The complete state of an attack on disk.

    Textures, moments and history (:meth:`AbstractAttack.tensors`), the states of the
    global random generators, the scenario with the hashes of its files, and versions.
    Writing is not put off to another thread: only so is a finished iteration never
    further from the disk than one checkpoint interval.

    Args:
        path: the file.
        identity: versions and scenario, see :meth:`Scenario.identity`.

    Attributes:
        iteration: of the state on disk, as far as this process knows; 0 without.
        seconds: that this process spent on writing.
        failed: whether the last attempt to write failed.
        ignored: differences that were ignored, over the file's life.
        flags: findings of the checks before the attack; None as long as this scenario
            was not checked.
    """

    def __init__(self, path: Path, identity: Mapping[str, str]) -> None:
        self.path = path
        identity = {"format": CHECKPOINT_FORMAT, **identity}
        self._unit = Unit(path, identity, CheckpointRecord, remedy=REMEDY)
        self.iteration = 0
        self.seconds = 0.0
        self.failed = False
        self.ignored: list[str] = []
        self.flags: list[str] | None = None
        self._checkpoint: UnitContent[CheckpointRecord] | None = None

    def read(self, force: bool = False) -> None:
        """Read and check the file, where there is one, for :meth:`restore`.

        Args:
            force: ignore what differs between the file and this run.

        Raises:
            InputError: the file is damaged, no checkpoint, or belongs to another
                scenario or other versions.
        """
        self._checkpoint = self._unit.read(force)
        if self._checkpoint is not None:
            self.ignored = [*self._checkpoint.record.ignored, *self._checkpoint.ignored]
            if not self._checkpoint.ignored:
                self.flags = self._checkpoint.record.flags

    @property
    def is_loaded(self) -> bool:
        """Whether :meth:`read` found a checkpoint."""
        return self._checkpoint is not None

    def restore(self, attack: AbstractAttack) -> None:
        """Give an attack the state that was read, which is forgotten here.

        Where differences are ignored, the best parameters are still to be judged:
        :meth:`AbstractAttack.judge_best`.

        Raises:
            InputError: an entry does not fit the objects.
        """
        checkpoint, self._checkpoint = self._checkpoint, None
        assert checkpoint is not None, "read() has found a checkpoint"
        needed = attack.tensors() | random_states()
        if checkpoint.ignored:  # of another scenario: without what this one adds
            needed = {
                name: needed[name] for name in needed if name in checkpoint.tensors
            }
        check_entries(self.path, checkpoint.tensors, needed)
        with misfits_reported(self.path):
            if checkpoint.ignored:
                attack.go_on_from(checkpoint.tensors)
            else:
                attack.load_tensors(checkpoint.tensors)
            restore_random_states(checkpoint.tensors)
        self.iteration = attack.iteration
        if checkpoint.ignored:
            self.save(attack)

    def save(self, attack: AbstractAttack) -> None:
        """Write the complete state.

        Args:
            attack: between two iterations.

        Raises:
            InputError: the file cannot be written; the one before is intact.
        """
        start = time.perf_counter()
        tensors = {**attack.tensors(), **random_states()}
        self.failed = True
        try:
            record = CheckpointRecord(ignored=self.ignored, flags=self.flags or [])
            self._unit.write(tensors, record)
        except InputError as err:
            raise InputError(f"{err}\n{self._advice(attack)}") from err
        self.failed = False
        self.iteration = attack.iteration
        self.seconds += time.perf_counter() - start

    def _advice(self, attack: AbstractAttack) -> str:
        status = (
            f"the checkpoint of iteration {self.iteration} is intact"
            if self.iteration
            else "there is no checkpoint yet"
        )
        return (
            f"iteration {attack.iteration} is not saved, {status}; the same command "
            "continues"
        )


class Effort(Record):
    """Cost of a run.

    Attributes:
        wall_s: seconds; those between a killed process's last save and its end are
            unknown.
        peak_memory_mb: of the process that needed most.
        renders: frames.
        checkpoint_s: seconds spent on writing checkpoints.
        processes: how many have worked on the run.
        forward_s: seconds of the attack's drives; the first drive of each process,
            which compiles, is left out.
        backward_s: seconds of their backward passes; the first pass of each process is
            left out.
    """

    wall_s: float = 0.0
    peak_memory_mb: float = 0.0
    renders: int = 0
    checkpoint_s: float = 0.0
    processes: int = 0
    forward_s: float = 0.0
    backward_s: float = 0.0

    @property
    def backward_multiple(self) -> float:
        """Cost of a backward pass, in drives; 1 where none was measured."""
        return self.backward_s / self.forward_s if self.forward_s else 1.0


class Account:
    """Adds what this process does to what earlier ones did.

    Args:
        started: `time.perf_counter()` at the start of this process's work.
        before: effort of the earlier processes.
    """

    def __init__(self, started: float, before: Effort) -> None:
        self._started, self._before = started, before
        self._passes = [0.0, 0.0]
        self._compiled = False

    def add_iteration(self, forward_s: float, backward_s: float) -> None:
        """Add the seconds of an iteration of the attack."""
        if self._compiled:
            self._passes[0] += forward_s
            self._passes[1] += backward_s
        self._compiled = True

    def total(self, renders: int, checkpoint_s: float) -> Effort:
        """Return the effort so far.

        Args:
            renders: frames of this process.
            checkpoint_s: seconds of this process.
        """
        before = self._before
        return Effort(
            wall_s=before.wall_s + time.perf_counter() - self._started,
            peak_memory_mb=max(
                before.peak_memory_mb, peak_memory_mb(), peak_of_children_mb()
            ),
            renders=before.renders + renders,
            checkpoint_s=before.checkpoint_s + checkpoint_s,
            processes=before.processes + 1,
            forward_s=before.forward_s + self._passes[0],
            backward_s=before.backward_s + self._passes[1],
        )


FORMAT = "mi_nerfattack attack effort 1"
METRICS = "metrics.json"


def object_path(folder: Path, name: str) -> Path:
    """Return the file of an attacked object, by its id, in a run folder."""
    return folder / "objects" / f"{name}.safetensors"


def read_finished(folder: Path) -> dict[str, Any]:
    """Read what ``metrics.json`` of a finished run holds.

    Raises:
        InputError: the folder holds no finished run, or the file is damaged.
    """
    path = folder / METRICS
    if not path.is_file():
        raise InputError(
            f"{folder}: holds no finished attack, {METRICS} is missing; give run "
            "folders of 'mi-nerfattack attack', which goes on with an unfinished one"
        )
    document = files.read_json(path)
    validate(document)
    return document


def folder_labels(folders: Sequence[Path]) -> list[str]:
    """Tell folders apart by as little of their paths as does it."""
    paths = [os.path.abspath(folder) for folder in folders]
    names = [Path(path).name for path in paths]
    if len(set(names)) == len(names):
        return names
    start = os.path.commonpath(paths)
    return [os.path.relpath(path, start) for path in paths]


def _stamp(path: Path) -> int | None:
    """Return when a file was last written, nanoseconds; None if there is none."""
    return path.stat().st_mtime_ns if path.exists() else None


class RunFolder:
    """A folder that this process has claimed, see :func:`claim.claimed`.

    Its files appear in this order: ``scenario.toml``; ``effort.safetensors``, which
    identifies the run; ``drives/`` with one file per drive; among them
    ``checkpoint.safetensors``; the results. A process may be killed between any two.

    Args:
        path: the folder.
        text: the scenario file, its paths absolute.
        identity: versions and scenario, see :meth:`Scenario.identity`.
        shared: folder of drives that other runs have in common with this one, if any.
    """

    def __init__(
        self,
        path: Path,
        text: str,
        identity: Mapping[str, str],
        shared: Path | None = None,
    ) -> None:
        self.path = path
        self.identity, self._text = identity, text
        self.checkpoint = CheckpointFile(path / CHECKPOINT, identity)
        self.drives = Store(path / DRIVES, shared)
        self.effort = Effort()
        own = {"format": FORMAT, **identity}
        self._effort = Unit(path / EFFORT, own, Effort, remedy=REMEDY)
        self._is_other = False  # than the run that was there before
        self._earlier: dict[Path, bytes] = {}
        self._iterated: int | None = None

    def read(self, force: bool, on_notice: Callable[[str], None]) -> None:
        """Take up what a run left; nothing is written.

        A killed writer may leave a folder with nothing but the beginning of its files.
        Such a folder counts as new, and its run starts from the beginning.

        Args:
            force: ignore that the run was of another scenario or other versions. Its
                attack continues, and drives that have changed are repeated.
            on_notice: called with a sentence for each difference that is ignored.

        Raises:
            InputError: a file is damaged, or the run was of another scenario or other
                versions.
        """
        is_new = not (self.checkpoint.path.exists() or self.drives.folder.exists())
        self.checkpoint.read(force)
        stored, ignored = self._effort.read(force), self.checkpoint.ignored
        if stored is not None:
            self.effort, ignored = stored.record, [*ignored, *stored.ignored]
        elif is_new:
            self._check_scenario(force, on_notice)
        self._is_other = bool(ignored)
        for line in dict.fromkeys(ignored):
            on_notice(f"{self.path}: ignored, as told: {line}")

    def begin(self) -> None:
        """Make the folder ready to work in."""
        locks.remove_partial(self.path)
        if self._is_other:
            paths = (self.path / SCENARIO, self._effort.path)
            self._earlier = {path: path.read_bytes() for path in paths if path.exists()}
        self._iterated = _stamp(self.checkpoint.path)
        files.write_text(self.path / SCENARIO, self._text)
        self.save(self.effort)

    def save(self, effort: Effort) -> None:
        """Write down what the run has cost so far."""
        self._effort.write({}, effort)

    def _check_scenario(self, force: bool, on_notice: Callable[[str], None]) -> None:
        """Refuse to replace a scenario of which nothing was done."""
        path = self.path / SCENARIO
        if path.exists() and files.read_text(path) != self._text:
            what = f"{path}: is another scenario, and nothing was done of it"
            if not force:
                raise InputError(
                    f"{what}; choose another folder, remove the file, or replace it "
                    "(--force)"
                )
            on_notice(f"{what}; replaced, as told")

    def withdraw(self) -> None:
        """Remove what was begun, unless an iteration of the attack is done.

        To be called where a scenario is refused: corrected, it is another one. A run of
        another scenario that was there before gets its scenario and its effort back.
        """
        if _stamp(self.checkpoint.path) != self._iterated:
            return
        for path, content in self._earlier.items():
            files.write_bytes(path, content)
        if not (self._earlier or self.checkpoint.path.exists()):
            self.drives.remove()
            self._effort.path.unlink()
            (self.path / SCENARIO).unlink()
