"""Finished drives: a file each, by all that decides about the drive."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mi_nerfattack.drives.spec import FORMAT, DriveSpec
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit, misfits_reported
from mi_nerfattack.rollout.drive import Drive

_REMEDY = "remove the file"


class DriveRecord(Record):
    """The labels of a kept drive, and what it cost.

    Attributes:
        environment: its label.
        route: name.
        case: what objects showed.
        run: index.
        seed: of the environment.
        wall_s: seconds.
    """

    environment: str
    route: str
    case: str
    run: int
    seed: int
    wall_s: float


@dataclass(frozen=True, eq=False)
class Finished:
    """A drive that is done.

    Attributes:
        drive: the drive.
        wall_s: seconds that it took.
    """

    drive: Drive
    wall_s: float


@dataclass(frozen=True)
class Store:
    """The finished drives of a folder.

    Args:
        folder: of the files; made with the first.
        shared: folder of drives that several such folders have in common; what is there
            is taken over, and what is added here is added there.
    """

    folder: Path
    shared: Path | None = None

    def path(self, spec: DriveSpec) -> Path:
        """Return the file of a drive."""
        return self.folder / _name(spec)

    def has(self, spec: DriveSpec) -> bool:
        """Tell whether a drive is done."""
        return self.path(spec).exists() or self._is_shared(spec)

    def read(self, spec: DriveSpec) -> Finished | None:
        """Read a drive; None where it is not done.

        Raises:
            InputError: the file is damaged.
        """
        unit = self._unit(self.path(spec), spec)
        stored = unit.read()
        if stored is None and self.shared is not None:
            stored = self._unit(self.shared / _name(spec), spec).read()
            if stored is not None:
                files.make_folder(unit.path.parent)
                unit.write(stored.tensors, stored.record)
        if stored is None:
            return None
        with misfits_reported(unit.path):
            return Finished(_drive(spec, stored.tensors), stored.record.wall_s)

    def add(self, spec: DriveSpec, drive: Drive, wall_s: float) -> None:
        """Write a drive.

        Args:
            spec: of the drive.
            drive: finished.
            wall_s: seconds that it took.

        Raises:
            InputError: the file cannot be written.
        """
        record = DriveRecord(
            environment=spec.environment,
            route=spec.route,
            case=spec.case,
            run=spec.run,
            seed=spec.seed,
            wall_s=wall_s,
        )
        for folder in (self.shared, self.folder):
            if folder is not None:
                unit = self._unit(folder / _name(spec), spec)
                files.make_folder(unit.path.parent)
                unit.write(drive.arrays(), record)

    def remove_others(self, specs: Collection[DriveSpec]) -> None:
        """Remove the files of all other drives."""
        paths = {self.path(spec) for spec in specs}
        for path in drive_files(self.folder):
            if path not in paths:
                path.unlink()

    def remove(self) -> None:
        """Remove all files, and the folders."""
        self.remove_others(())
        for folder in [*self.folder.glob("*"), self.folder]:
            if folder.is_dir():
                folder.rmdir()

    def _is_shared(self, spec: DriveSpec) -> bool:
        return self.shared is not None and (self.shared / _name(spec)).exists()

    def _unit(self, path: Path, spec: DriveSpec) -> Unit[DriveRecord]:
        return Unit(path, spec.identity, DriveRecord, remedy=_REMEDY)


def _name(spec: DriveSpec) -> str:
    folder = quote(spec.environment, safe="@")
    return f"{folder}/{spec.case}_{spec.run:04d}-{spec.digest}.safetensors"


def drive_files(folder: Path) -> list[Path]:
    """Return the files of drives, by environment, case and run."""
    return sorted(folder.glob("*/*.safetensors"))


def read_drive(path: Path) -> Drive:
    """Read a finished drive, whatever it is of.

    Raises:
        InputError: the file is missing, damaged, or of another format.
    """
    stored = Unit(path, {"format": FORMAT}, DriveRecord, remedy=_REMEDY).read(
        force=True
    )
    if stored is None:
        raise InputError(f"{path}: missing; it was removed")
    with misfits_reported(path):
        return _drive(stored.record, stored.tensors)


def _drive(labels: DriveSpec | DriveRecord, tensors: Mapping[str, Any]) -> Drive:
    """Put a drive together from its labels and its arrays."""
    return Drive(
        environment=labels.environment,
        route=labels.route,
        case=labels.case,
        run=labels.run,
        seed=labels.seed,
        **tensors,
    )


def read_drives(folder: Path) -> list[Drive]:
    """Read all finished drives of a folder, see :func:`read_drive`."""
    return [read_drive(path) for path in drive_files(folder)]
