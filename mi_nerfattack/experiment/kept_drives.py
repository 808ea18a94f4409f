"""Drives that are finished: kept in the run folder, so that none is repeated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mi_nerfattack.attack.checkpoint import REMEDY
from mi_nerfattack.errors import InputError
from mi_nerfattack.io.resumable import read_kept, write_kept
from mi_nerfattack.rollout.drive import Drive

FORMAT = "mi_nerfattack drives 1"
_ARRAYS = ("states", "controls", "cross_track_m", "time_s")


class KeptDrives:
    """A file of finished drives, replaced atomically with each that is added.

    Args:
        path: the file.
        identity: versions and scenario, see :meth:`Scenario.identity`.
        route: that all drives follow.
        seed: of all drives.
    """

    def __init__(
        self, path: Path, identity: Mapping[str, str], route: str, seed: int
    ) -> None:
        self.path = path
        self.identity = {"format": FORMAT, **identity}
        self._route, self._seed = route, seed
        self._drives: dict[tuple[str, str, int], Drive] = {}

    def read(self, force: bool = False) -> tuple[dict[str, str], list[str]]:
        """Take up the drives of the file, where there is one.

        Args:
            force: where the file belongs to another scenario or other versions, take
                up none, in place of an error.

        Returns:
            remarks that were saved with it, and the differences that were ignored.

        Raises:
            InputError: the file is damaged, of another format, or belongs to another
                scenario or other versions.
        """
        if not self.path.exists():
            return {}, []
        kept = read_kept(self.path, self.identity, REMEDY, force)
        if not kept.ignored:
            for name in kept.tensors:
                if name.endswith("/states"):
                    self._add(self._drive(name.rpartition("/")[0], kept.tensors))
        return kept.about, kept.ignored

    def take(
        self, environment: str, case: str, runs: Sequence[int]
    ) -> list[Drive] | None:
        """Return the drives of some runs, None unless all of them are there."""
        found = [self._drives.get((environment, case, run)) for run in runs]
        whole = [drive for drive in found if drive is not None]
        return whole if len(whole) == len(found) else None

    def drop(self, case: str) -> None:
        """Forget the drives of a case."""
        for key in [key for key in self._drives if key[1] == case]:
            del self._drives[key]

    def add(self, drives: Sequence[Drive], about: Mapping[str, str]) -> None:
        """Keep drives on disk.

        Args:
            drives: may be empty.
            about: remarks to keep with them.
        """
        for drive in drives:
            self._add(drive)
        tensors = {
            f"{'/'.join(map(str, key))}/{name}": getattr(drive, name)
            for key, drive in self._drives.items()
            for name in _ARRAYS
        }
        write_kept(self.path, tensors, self.identity, about)

    def _add(self, drive: Drive) -> None:
        self._drives[drive.environment, drive.case, drive.run] = drive

    def _drive(self, key: str, tensors: Mapping[str, np.ndarray]) -> Drive:
        try:
            environment, case, run = key.split("/")
            arrays = {name: tensors[f"{key}/{name}"] for name in _ARRAYS}
            return Drive(environment, self._route, case, int(run), self._seed, **arrays)
        except (KeyError, ValueError) as err:
            raise InputError(
                f"{self.path}: drive {key!r} is damaged ({err}); start again without "
                "the file"
            ) from err
