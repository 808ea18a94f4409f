"""The drives of a transfer: each a file, done once, shared between attacks."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.driving import drive
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.registry import environment_versions
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.identity import short_digest
from mi_nerfattack.evaluation.work import DriveRecord
from mi_nerfattack.experiment.kept_drives import decisive
from mi_nerfattack.experiment.transfer.columns import Column
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Unit
from mi_nerfattack.ranges import Count, Seed, checked
from mi_nerfattack.rollout.drive import (
    ATTACK,
    BEST_RANDOM,
    NO_OBJECT,
    OWN,
    Drive,
)
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.scenario import is_within
from mi_nerfattack.scenario.world import Appearance, World, build_world
from mi_nerfattack.system.workers import AbstractWork, OnUnits

FORMAT = "mi_nerfattack transfer drive 1"
#: What objects can show, in the order of documents.
CASES = (NO_OBJECT, OWN, BEST_RANDOM, ATTACK)
_REMEDY = "choose another folder with -o, or remove this file"


@dataclass(frozen=True, eq=False)
class Batch:
    """The drives of one case in one column, from all starts.

    Attributes:
        number: of an attack that it belongs to; other ones may share it.
        column: environment and condition.
        case: one of `CASES`.
        identity: all that decides about its drives but their starts.
    """

    number: int
    column: Column
    case: str
    identity: Mapping[str, str]

    @cached_property
    def digest(self) -> str:
        """Tell it from others."""
        return short_digest(self.identity)


@dataclass(frozen=True, eq=False)
@checked("transfer")
class TransferWork(AbstractWork):
    """All drives of a transfer; a piece is a batch.

    Args:
        attacks: found.
        columns: where they are driven, and the objects as they were.
        cases: of `CASES`.
        starts: drives of each batch.
        seed: of starts, images and errors.
        folder: of the drives.
    """

    attacks: tuple[FoundAttack, ...]
    columns: tuple[Column, ...]
    cases: tuple[str, ...]
    starts: Count
    seed: Seed
    folder: Path

    def __post_init__(self) -> None:
        """Check what the types do not."""
        if not self.cases or len(set(self.cases)) < len(self.cases):
            raise InputError(f"--cases: {' '.join(self.cases)!r}; each once")
        for case in self.cases:
            if case not in CASES:
                raise InputError(f"--cases: {case!r}; of {', '.join(CASES)}")
        for found in self.attacks:
            if BEST_RANDOM in self.cases and found.best_random is None:
                raise InputError(
                    f"{found.folder}: has no random looks; leave {BEST_RANDOM} out of "
                    "--cases"
                )
            found.check_starts(self.seed, self.starts)
            for column in self.columns:
                column.check(found.scenario)

    @cached_property
    def rows(self) -> dict[tuple[int, Column], dict[str, Batch]]:
        """Batches by case, of each attack in each column."""
        known: dict[str, Batch] = {}
        found: dict[tuple[int, Column], dict[str, Batch]] = {}
        for number, _ in enumerate(self.attacks):
            for column in self.columns:
                batches = [self._batch(number, column, case) for case in self.cases]
                batches = [known.setdefault(b.digest, b) for b in batches]
                cells = zip(self.cases, batches, strict=True)
                found[number, column] = dict(cells)
        return found

    @cached_property
    def batches(self) -> list[Batch]:
        """All batches, each once, those of one row together."""
        cells = [batch for row in self.rows.values() for batch in row.values()]
        return list({batch.digest: batch for batch in cells}.values())

    def open(self) -> Opened:
        """Load nothing yet."""
        return Opened(self.attacks)

    def do(self, opened: Opened, index: int, report: OnUnits) -> None:
        """Do the drives of a batch that are not done; a unit is a control period."""
        batch = self.batches[index]
        found = self.attacks[batch.number]
        for start in range(self.starts):
            if self.path(batch, start).exists():
                continue
            pose, seed = found.start(self.seed, start)
            world = opened.world(batch.number)
            environment = opened.environment(batch, seed)
            begun = time.monotonic()
            with one_thread():
                result = drive(
                    environment,
                    world.policy,
                    world.route,
                    pose,
                    seed,
                    world.horizon,
                    lambda step: report(1),
                    batch.case,
                    start,
                    batch.column.environment,
                )
            record = DriveRecord(seed=seed, wall_s=time.monotonic() - begun)
            files.make_folder(self.path(batch, start).parent)
            self._unit(batch, start).write(result.arrays(), record)

    def close(self, opened: Opened) -> None:
        """Close the environment."""
        opened.close()

    def path(self, batch: Batch, start: int) -> Path:
        """Return the file of a drive."""
        column = batch.column
        condition = quote(column.condition.label, safe="")
        folder = self.folder / column.environment / condition
        name = f"{batch.case}-{batch.digest}"
        return folder / name / f"start_{start:04d}.safetensors"

    def read(self, batch: Batch) -> list[Drive | None]:
        """Read the drives of a batch; None for one that is not done.

        Raises:
            InputError: a file is damaged, or of another transfer.
        """
        found = self.attacks[batch.number]
        drives: list[Drive | None] = []
        for start in range(self.starts):
            kept = self._unit(batch, start).read()
            about = batch.column.environment, found.route.name, batch.case, start
            drives.append(
                None
                if kept is None
                else Drive(*about, kept.record.seed, **kept.tensors)
            )
        return drives

    def _unit(self, batch: Batch, start: int) -> Unit[DriveRecord]:
        identity = {**batch.identity, "start": f"{start}"}
        return Unit(self.path(batch, start), identity, DriveRecord, _REMEDY)

    def _batch(self, number: int, column: Column, case: str) -> Batch:
        """Describe all that decides about drives, and nothing else."""
        found = self.attacks[number]
        column = column.without_objects if case == NO_OBJECT else column
        names = {**versions(), **environment_versions(column.name)}
        identity = {
            "format": FORMAT,
            **{f"version.{name}": value for name, value in names.items()},
            **_decisive(found, column, case),
            "column": json.dumps(column.identity(), sort_keys=True),
            "case": case,
            "seed": f"{self.seed}",
        }
        return Batch(number, column, case, identity)


class Opened:
    """What a process needs for its drives: one world and one environment at a time."""

    def __init__(self, attacks: Sequence[FoundAttack]) -> None:
        self._attacks = attacks
        self._number = -1
        self._world: World | None = None
        self._looks: dict[str, Appearance] = {}
        self._opened: tuple[Any, AbstractEnvironment] | None = None

    def world(self, number: int) -> World:
        """Return the world of an attack."""
        if self._world is None or self._number != number:
            self.close()
            found = self._attacks[number]
            world = build_world(found.scenario, found.scenario.policy.build())
            self._world, self._number = world, number
            self._looks = found.looks(world)
        return self._world

    def environment(self, batch: Batch, seed: int) -> AbstractEnvironment:
        """Return a batch's environment for one drive, the objects in their places."""
        world, column = self.world(batch.number), batch.column
        if batch.case != NO_OBJECT:
            look, errors = self._looks[batch.case], column.condition.errors
            offsets = errors.offsets(look.offsets, seed)
            world.show(Appearance(look.textures, offsets))
        key = batch.digest, seed if column.serves_one_start else None
        if self._opened is None or self._opened[0] != key:
            self._close_environment()
            objects = [] if batch.case == NO_OBJECT else world.surrogate.objects
            self._opened = key, column.open(world, objects, seed)
        return self._opened[1]

    def close(self) -> None:
        """Close the environment, and forget the world."""
        self._close_environment()
        self._world, self._looks = None, {}

    def _close_environment(self) -> None:
        if self._opened is not None:
            self._opened[1].close()
        self._opened = None


def _decisive(found: FoundAttack, column: Column, case: str) -> dict[str, str]:
    """Return what of a scenario, and of what was found, decides about drives."""
    inert, named = ["deployment"], {}
    if case == NO_OBJECT:
        inert.append("objects")
    if case in (ATTACK, BEST_RANDOM):
        named["found"] = found.digest
    if case == BEST_RANDOM:
        scenario = found.scenario
        look = scenario.seed, scenario.baseline.kind, found.best_random
        named["look"] = json.dumps(look)
    in_surrogate = column.environment == SURROGATE
    driven = decisive(found.scenario, found.identity, in_surrogate).items()
    return named | {k: value for k, value in driven if not is_within(k, inert)}
