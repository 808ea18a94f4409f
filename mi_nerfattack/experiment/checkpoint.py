"""Checkpoints of an attack: one file, replaced atomically."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.backend.determinism import random_states, restore_random_states
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.io.resumable import (
    Kept,
    Record,
    Unit,
    check_entries,
    misfits_told,
)

FORMAT = "mi_nerfattack attack checkpoint 8"
REMEDY = (
    "go on with the scenario.toml of the run folder and the same files and versions, "
    "start a new run folder, or ignore this (--force)"
)


class CheckpointRecord(Record):
    """What is kept beside the state.

    The cost so far, differences that were ignored, findings of the checks before.
    """

    effort: Effort
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
        identity = {"format": FORMAT, **identity}
        self._unit = Unit(path, identity, CheckpointRecord, REMEDY)
        self.iteration = 0
        self.seconds = 0.0
        self.failed = False
        self.ignored: list[str] = []
        self.flags: list[str] | None = None
        self._kept: Kept[CheckpointRecord] | None = None

    def read(self, force: bool = False) -> Effort:
        """Read and check the file, where there is one, for :meth:`restore`.

        Args:
            force: ignore what differs between the file and this run.

        Returns:
            the cost until it was saved.

        Raises:
            InputError: the file is damaged, no checkpoint, or belongs to another
                scenario or other versions.
        """
        self._kept = self._unit.read(force)
        if self._kept is None:
            return Effort()
        self.ignored = [*self._kept.record.ignored, *self._kept.ignored]
        if not self._kept.ignored:
            self.flags = self._kept.record.flags
        return self._kept.record.effort

    @property
    def found(self) -> bool:
        """Whether :meth:`read` found a checkpoint."""
        return self._kept is not None

    def restore(self, attack: AbstractAttack) -> None:
        """Give an attack the state that was read, which is forgotten here.

        Where differences are ignored, the best parameters are still to be judged:
        :meth:`AbstractAttack.judge_best`.

        Raises:
            InputError: an entry does not fit the objects.
        """
        kept, self._kept = self._kept, None
        assert kept is not None, "read() has found a checkpoint"
        needed = attack.tensors() | random_states()
        if kept.ignored:  # of another scenario: without what this one adds
            needed = {name: needed[name] for name in needed if name in kept.tensors}
        check_entries(self.path, kept.tensors, needed)
        with misfits_told(self.path):
            if kept.ignored:
                attack.go_on_from(kept.tensors)
            else:
                attack.load_tensors(kept.tensors)
            restore_random_states(kept.tensors)
        self.iteration = attack.iteration
        if kept.ignored:
            self.save(attack, kept.record.effort)

    def save(self, attack: AbstractAttack, effort: Effort) -> None:
        """Write the complete state.

        Args:
            attack: between two iterations.
            effort: so far.

        Raises:
            InputError: the file cannot be written; the one before is intact.
        """
        start = time.perf_counter()
        tensors = {**attack.tensors(), **random_states()}
        self.failed = True
        try:
            about = {"ignored": self.ignored, "flags": self.flags or []}
            record = CheckpointRecord(effort=effort, **about)
            self._unit.write(tensors, record)
        except InputError as err:
            raise InputError(f"{err}\n{self._advice(attack)}") from err
        self.failed = False
        self.iteration = attack.iteration
        self.seconds += time.perf_counter() - start

    def _advice(self, attack: AbstractAttack) -> str:
        kept = (
            f"the checkpoint of iteration {self.iteration} is intact"
            if self.iteration
            else "there is no checkpoint yet"
        )
        return (
            f"iteration {attack.iteration} is not saved, {kept}; the same command "
            "continues"
        )
