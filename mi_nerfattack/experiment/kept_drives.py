"""Drives that are finished: files of the run folder, so that none is repeated.

Those that several runs of one sweep have in common are done by the first of them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.registry import environment_versions
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.identity import short_digest
from mi_nerfattack.experiment.checkpoint import REMEDY
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.io import files
from mi_nerfattack.io.digest import array_digest
from mi_nerfattack.io.resumable import Record, Unit, misfits_told
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.named_file import NamedFile
from mi_nerfattack.scenario.scenario import Scenario, is_within
from mi_nerfattack.scenario.world import Appearance, World

FORMAT = "mi_nerfattack attack drive 4"
SHARED_FORMAT = "mi_nerfattack shared drive 1"
#: Parts of a scenario that say how it is searched, not how it is driven.
OF_SEARCH = ("name", "attack", "baseline", "objective", "scene.bricks", "drive.runs")


#: Parts that only drives in the surrogate depend on.
_OF_SURROGATE = ("field", "composite", "step_m", "stop", "to_world")


def decisive(
    scenario: Scenario, identity: Mapping[str, str], in_surrogate: bool
) -> dict[str, str]:
    """Return what of a scenario decides about drives in an environment.

    Not what objects show, where a drive starts, and its seed.

    Args:
        scenario: of the drives.
        identity: its :meth:`Scenario.identity`.
        in_surrogate: whether they are in the surrogate, not in a deployment.
    """
    inert, named = [*OF_SEARCH, "seed"], {}
    if in_surrogate:
        inert.append("scene.deployment")
        own = scenario.attack
        # a Mitsuba scene says itself what is random
        random = own.jitter or scenario.scene.surrogate is not None
        seed = f"{scenario.seed}" if random else "none"
        named = {"random": seed, "attached": f"{own.attached}"}
    else:
        inert += [f"scene.{name}" for name in _OF_SURROGATE]
    return named | {k: v for k, v in identity.items() if not is_within(k, inert)}


class DriveRecord(Record):
    """Which drive of the run it is, its objective, and the cost of the run so far."""

    environment: str
    case: str
    run: int
    objective: float | None
    effort: Effort


def read_drive(path: Path, route: str) -> Drive:
    """Read a finished drive, whatever scenario and versions it is of.

    Args:
        path: of a file in the folder of a run's drives.
        route: that it follows.

    Raises:
        InputError: the file is damaged, or of another format.
    """
    unit = Unit(path, {"format": FORMAT}, DriveRecord, REMEDY)
    kept = unit.read(force=True)
    if kept is None:
        raise InputError(f"{path}: missing; it was removed")
    record = kept.record
    with misfits_told(path):
        about = record.environment, route, record.case, record.run
        return Drive(*about, record.run, **kept.tensors)


class KeptDrives:
    """The finished drives of a run, a file each.

    Args:
        folder: of the files; made with the first.
        identity: versions and scenario, see :meth:`Scenario.identity`.
        route: that all drives follow.
        seed: of the first drive of a case; that of run k is k more.
    """

    def __init__(
        self, folder: Path, identity: Mapping[str, str], route: str, seed: int
    ) -> None:
        self.folder = folder
        self._identity = {"format": FORMAT, **identity}
        self._route, self._seed = route, seed
        self._drives: dict[tuple[str, str, int], Drive] = {}
        self._objectives: dict[tuple[str, str, int], float | None] = {}

    def paths(self) -> list[Path]:
        """Return the files of drives that are there."""
        return sorted(self.folder.glob("*.safetensors"))

    def read(self, force: bool = False) -> tuple[Effort, list[str]]:
        """Take up the drives that are there.

        Args:
            force: leave out those of another scenario or other versions, in place of
                an error.

        Returns:
            the cost until the last was saved, and the differences that were ignored.

        Raises:
            InputError: a file is damaged, of another format, or belongs to another
                scenario or other versions.
        """
        efforts, ignored = [Effort()], []
        for path in self.paths():
            kept = self._unit(path).read(force)
            assert kept is not None, "no other process works in the folder"
            record = kept.record
            efforts.append(record.effort)
            ignored += kept.ignored
            if not kept.ignored:
                about = (record.environment, self._route, record.case, record.run)
                with misfits_told(path):
                    seed = self._seed + record.run
                    drive = Drive(*about, seed, **kept.tensors)
                self._take_up(drive, record.objective)
        return max(efforts, key=lambda effort: effort.wall_s), ignored

    def take(self, environment: str, case: str, run: int) -> Drive | None:
        """Return a drive, None unless it is there."""
        return self._drives.get((environment, case, run))

    def objective(self, environment: str, case: str, run: int) -> float | None:
        """Return what :meth:`add` was told of a drive that is there."""
        return self._objectives[environment, case, run]

    def drop(self, case: str) -> None:
        """Forget the drives of a case."""
        for key in [key for key in self._drives if key[1] == case]:
            del self._drives[key]

    def remove_others(self) -> None:
        """Remove the files of drives that were not taken up."""
        kept = {self._path(*key) for key in self._drives}
        for path in set(self.paths()) - kept:
            path.unlink()

    def remove(self) -> None:
        """Remove all files, and the folder."""
        for path in self.paths():
            path.unlink()
        if self.folder.exists():
            self.folder.rmdir()

    def add(self, drive: Drive, effort: Effort, objective: float | None = None) -> None:
        """Write a drive of this run.

        Args:
            drive: finished.
            effort: what the run has cost so far.
            objective: the attack's, for the look of a random drive.
        """
        files.make_folder(self.folder)
        environment, case, run = drive.environment, drive.case, drive.run
        record = DriveRecord(
            environment=environment,
            case=case,
            run=run,
            objective=objective,
            effort=effort,
        )
        path = self._path(environment, case, run)
        self._unit(path).write(drive.arrays(), record)
        self._take_up(drive, objective)

    def _take_up(self, drive: Drive, objective: float | None) -> None:
        key = drive.environment, drive.case, drive.run
        self._drives[key], self._objectives[key] = drive, objective

    def _unit(self, path: Path) -> Unit[DriveRecord]:
        return Unit(path, self._identity, DriveRecord, REMEDY)

    def _path(self, environment: str, case: str, run: int) -> Path:
        return self.folder / f"{environment}_{case}_{run:04d}.safetensors"


@dataclass(frozen=True)
class SharedDrives:
    """Drives of one sweep by all that decides about them, a file each.

    How an attack searches has no part in a drive: what objects show, and where they
    stand, has. Cells that differ by their method alone have the drives without
    objects, past their own textures and past equal random looks in common.

    Args:
        folder: of the files; made with the first.
    """

    folder: Path
    _contents: dict[NamedFile, dict[str, str]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def _content(self, named: NamedFile) -> dict[str, str]:
        """Read a file once, however many drives depend on it."""
        if named not in self._contents:
            self._contents[named] = named.content()
        return self._contents[named]

    def unit(
        self, world: World, label: str, look: Appearance | None, run: int
    ) -> Unit[Record]:
        """Return the file of a drive.

        Args:
            world: of the run.
            label: of the environment.
            look: of all objects; None without.
            run: index of the drive.
        """
        scenario, needed, here = world.scenario, {}, label == SURROGATE
        if not here:
            needed = environment_versions(world.deployments[label].environment)
        start = world.initial[run % len(world.initial)]
        identity = {
            "format": SHARED_FORMAT,
            **{f"version.{k}": v for k, v in (versions() | needed).items()},
            **decisive(scenario, scenario.identity(self._content), here),
            "environment": label,
            "look": "none"
            if look is None
            else array_digest((*look.textures, look.offsets)),
            "start": json.dumps(np.asarray(start).tolist()),
            "drive_seed": f"{scenario.seed + run}",
        }
        path = self.folder / f"{label}_{short_digest(identity)}.safetensors"
        return Unit(path, identity, Record, "remove the file")
