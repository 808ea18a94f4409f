"""Drives that are missing, driven by several processes."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.deploy.environment import OpenEnvironment
from mi_nerfattack.drives.spec import DriveSpec
from mi_nerfattack.drives.store import Finished, Store
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.system.workers import (
    AbstractWork,
    AbstractWorkers,
    OnUnits,
    raise_failure,
    tally,
)

#: Called with control periods done and wanted.
OnSteps = Callable[[int, int], None]
#: Finished drives by the number of their group.
Groups = Mapping[int, Sequence[Finished]]


def _quiet(done: int, total: int) -> None:
    del done, total


class AbstractDriver(ABC):
    """What a process keeps between its drives.

    Attributes:
        environment: the one that is open.
    """

    def __init__(self) -> None:
        self.environment = OpenEnvironment()

    @abstractmethod
    def drive(self, spec: DriveSpec, on_step: OnStep) -> Drive:
        """Drive once.

        Args:
            spec: of the drive.
            on_step: called after each control period; an exception ends the drive.
        """

    def close(self) -> None:
        """Close what is open."""
        self.environment.close()


@dataclass(frozen=True, eq=False)
class AbstractDrives(AbstractWork):
    """Drives of an experiment; a piece is a group that one process does.

    Args:
        store: of those that are finished.
    """

    store: Store

    @cached_property
    @abstractmethod
    def groups(self) -> Sequence[Sequence[DriveSpec]]:
        """All drives; those of one group have an environment in common."""

    @abstractmethod
    def open(self) -> AbstractDriver:
        """Make the driver of a process."""

    def check(self, missing: Sequence[DriveSpec]) -> None:
        """Raise InputError for what cannot be driven, before the first drive.

        Args:
            missing: drives that are not done.
        """
        del missing

    def do(self, opened: AbstractDriver, index: int, report: OnUnits) -> None:
        """Do the drives of a group that are not done; a unit is a control period."""
        for spec in self.groups[index]:
            if not self.store.has(spec):
                self.drive(opened, spec, lambda step: report(1))

    def drive(self, driver: AbstractDriver, spec: DriveSpec, on_step: OnStep) -> Drive:
        """Drive once, and keep the drive."""
        begun = time.monotonic()
        with one_thread():
            drive = driver.drive(spec, on_step)
        self.store.add(spec, drive, time.monotonic() - begun)
        return drive

    def close(self, opened: AbstractDriver) -> None:
        """Close the driver."""
        opened.close()


def run_drives(
    work: AbstractDrives,
    workers: AbstractWorkers,
    progress: OnSteps = _quiet,
    on_groups: Callable[[Groups], None] = lambda groups: None,
) -> list[list[Finished]]:
    """Do the drives that are missing.

    Args:
        work: all drives.
        workers: who does them.
        progress: called with control periods done and wanted.
        on_groups: called with the groups that are done at first, then with each that
            is done.

    Returns:
        the drives, as the groups have them.

    Raises:
        InputError: a file is damaged, or as of `AbstractDrives.check`, before
            the first drive; later, whatever a drive raises.
    """
    groups, store = work.groups, work.store
    stored = [[store.read(spec) for spec in group] for group in groups]
    pairs = [list(zip(*both, strict=True)) for both in zip(groups, stored, strict=True)]
    left = [[spec for spec, item in pair if item is None] for pair in pairs]
    missing = [spec for group in left for spec in group]
    total = sum(spec.steps for group in groups for spec in group)
    done = total - sum(spec.steps for spec in missing)
    work.check(missing)
    finished = {
        index: [item for item in items if item is not None]
        for index, items in enumerate(stored)
        if not left[index]
    }

    def on_end(index: int, error: Exception | None) -> None:
        raise_failure(index, error)
        items = []
        for spec in groups[index]:
            if (item := store.read(spec)) is None:
                raise InputError(f"{store.path(spec)}: missing; it was removed")
            items.append(item)
        finished[index] = items
        on_groups({index: items})

    on_groups(dict(finished))
    pieces = [index for index, specs in enumerate(left) if specs]
    workers.run(work, pieces, tally(progress, done, total), on_end)
    return [finished[index] for index in range(len(groups))]
