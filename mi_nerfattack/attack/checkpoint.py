"""Checkpoints of an attack: one safetensors file, replaced atomically."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.backend.determinism import random_states, restore_random_states
from mi_nerfattack.errors import InputError
from mi_nerfattack.io.resumable import Kept, read_kept, write_kept

FORMAT = "mi_nerfattack attack checkpoint 3"
REMEDY = (
    "resume with the scenario.toml of the run folder and the same files and versions, "
    "start a new run folder, or ignore this (--force)"
)


class CheckpointFile:
    """The complete state of an attack on disk.

    Textures, moments and history (:meth:`GradientAttack.tensors`), the states of the
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
    """

    def __init__(self, path: Path, identity: Mapping[str, str]) -> None:
        self.path = path
        self.identity = {"format": FORMAT, **identity}
        self.iteration = 0
        self.seconds = 0.0
        self.failed = False
        self.ignored: list[str] = []
        self._kept: Kept | None = None

    def read(self, force: bool = False) -> dict[str, str]:
        """Read and check the file, where there is one, for :meth:`restore`.

        Args:
            force: ignore what differs between the file and this run.

        Returns:
            remarks that were saved with it.

        Raises:
            InputError: the file is damaged, no checkpoint, or belongs to another
                scenario or other versions.
        """
        if not self.path.exists():
            return {}
        self._kept = read_kept(self.path, self.identity, REMEDY, force)
        earlier = json.loads(self._kept.about.get("ignored", "[]"))
        self.ignored = [*earlier, *self._kept.ignored]
        return self._kept.about

    @property
    def found(self) -> bool:
        """Whether :meth:`read` found a checkpoint."""
        return self._kept is not None

    def restore(self, attack: GradientAttack) -> None:
        """Give an attack the state that was read, which is forgotten here.

        Where differences are ignored, the best parameters are still to be judged:
        :meth:`GradientAttack.judge_best`.

        Raises:
            InputError: an entry is missing, or does not fit the objects.
        """
        kept, self._kept = self._kept, None
        assert kept is not None, "read() has found a checkpoint"
        self._check_shapes(attack.tensors(), kept.tensors)
        try:
            if kept.ignored:
                attack.go_on_from(kept.tensors)
            else:
                attack.load_tensors(kept.tensors)
            restore_random_states(kept.tensors)
        except KeyError as err:
            raise InputError(
                f"{self.path}: entry {err} is missing; the file is damaged, start a "
                "new run folder"
            ) from err
        self.iteration = attack.iteration
        if kept.ignored:
            self.save(attack, kept.about)

    def save(self, attack: GradientAttack, about: Mapping[str, str]) -> None:
        """Write the complete state.

        Args:
            attack: between two iterations.
            about: remarks to keep with it.

        Raises:
            InputError: the file cannot be written; the one before is intact.
        """
        start = time.perf_counter()
        tensors = {**attack.tensors(), **random_states()}
        remarks = {**about, "ignored": json.dumps(self.ignored)}
        self.failed = True
        try:
            write_kept(self.path, tensors, self.identity, remarks)
        except InputError as err:
            raise InputError(f"{err}\n{self._advice(attack)}") from err
        self.failed = False
        self.iteration = attack.iteration
        self.seconds += time.perf_counter() - start

    def _advice(self, attack: GradientAttack) -> str:
        kept = (
            f"the checkpoint of iteration {self.iteration} is intact"
            if self.iteration
            else "there is no checkpoint yet"
        )
        return (
            f"iteration {attack.iteration} is not saved, {kept}; continue "
            "with 'mi-nerfattack attack --resume'"
        )

    def _check_shapes(
        self, needed: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]
    ) -> None:
        """Compare what has a size of its own; a new attack's history is empty."""
        for name, value in needed.items():
            if name in found and value.size and found[name].shape != value.shape:
                raise InputError(
                    f"{self.path}: {name} has shape {found[name].shape}, this run "
                    f"needs {value.shape}; start a new run folder"
                )
