"""The drives of a transfer: each a file, done once, shared between attacks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from mi_nerfattack.deploy.environment import drive
from mi_nerfattack.drives.run import AbstractDriver, AbstractDrives
from mi_nerfattack.drives.spec import DriveSpec, identify, short_digest
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.cases import decisive
from mi_nerfattack.experiment.transfer.columns import Column
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.ranges import Count, Seed, checked
from mi_nerfattack.rollout.drive import (
    ATTACK,
    BEST_RANDOM,
    NO_OBJECT,
    OWN,
    Drive,
)
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.scenario import is_within
from mi_nerfattack.scenario.world import Appearance, World, build_world

#: What objects can show, in the order of documents.
CASES = (NO_OBJECT, OWN, BEST_RANDOM, ATTACK)


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
class TransferDrives(AbstractDrives):
    """All drives of a transfer; a group is a batch.

    Args:
        store: of those that are finished.
        attacks: found.
        columns: where they are driven, and the objects as they were.
        cases: of `CASES`.
        starts: drives of each batch.
        seed: of starts, images and errors.
    """

    attacks: tuple[FoundAttack, ...]
    columns: tuple[Column, ...]
    cases: tuple[str, ...]
    starts: Count
    seed: Seed

    def __post_init__(self) -> None:
        if not self.cases or len(set(self.cases)) < len(self.cases):
            raise InputError(f"--cases: {' '.join(self.cases)!r}; each once")
        for case in self.cases:
            if case not in CASES:
                raise InputError(f"--cases: {case!r}; of {', '.join(CASES)}")
        for attack in self.attacks:
            if BEST_RANDOM in self.cases and attack.best_random is None:
                raise InputError(
                    f"{attack.folder}: has no random textures; leave {BEST_RANDOM} out "
                    "of --cases"
                )
            attack.check_starts(self.seed, self.starts)
            for column in self.columns:
                column.check(attack.scenario)

    @cached_property
    def rows(self) -> dict[tuple[int, Column], dict[str, Batch]]:
        """Batches by case, of each attack in each column."""
        known: dict[str, Batch] = {}
        rows: dict[tuple[int, Column], dict[str, Batch]] = {}
        for number, _ in enumerate(self.attacks):
            for column in self.columns:
                batches = [self._batch(number, column, case) for case in self.cases]
                batches = [known.setdefault(b.digest, b) for b in batches]
                cells = zip(self.cases, batches, strict=True)
                rows[number, column] = dict(cells)
        return rows

    @cached_property
    def batches(self) -> list[Batch]:
        """All batches, each once, those of one row together."""
        cells = [batch for row in self.rows.values() for batch in row.values()]
        return list({batch.digest: batch for batch in cells}.values())

    @cached_property
    def groups(self) -> Sequence[Sequence[DriveSpec]]:
        """The drives of all batches."""
        return [
            [self._spec(batch, start) for start in range(self.starts)]
            for batch in self.batches
        ]

    def open(self) -> TransferDriver:
        """Load nothing yet."""
        return TransferDriver(self.attacks)

    def check(self, missing: Sequence[DriveSpec]) -> None:
        """Make every environment once in each scene under each sky, without objects.

        Raises:
            InputError: one cannot be made.
        """
        driver, opened = self.open(), set()
        for spec in missing:
            batch, _ = spec.context
            column, attack = batch.column, self.attacks[batch.number]
            scene = attack.identity["scenario.scene.deployment"]
            key = scene, column.name, column.condition.sky
            if key not in opened:
                opened.add(key)
                column.open(driver.world(batch.number), [], 0).close()
        driver.close()

    def _batch(self, number: int, column: Column, case: str) -> Batch:
        """Describe all that decides about drives, and nothing else."""
        column = column.without_objects if case == NO_OBJECT else column
        identity = _decisive(self.attacks[number], column, case)
        identity |= {"column": column.identity(), "case": case, "seed": self.seed}
        return Batch(number, column, case, identity=identify(column.name, identity))

    def _spec(self, batch: Batch, start: int) -> DriveSpec:
        attack = self.attacks[batch.number]
        pose, seed = attack.start(self.seed, start)
        return DriveSpec(
            environment=batch.column.environment,
            route=attack.route.name,
            case=batch.case,
            run=start,
            seed=seed,
            steps=attack.horizon,
            identity={**batch.identity, "start": f"{start}"},
            context=(batch, pose),
        )


class TransferDriver(AbstractDriver):
    """Drives past found attacks: one world and one environment at a time."""

    def __init__(self, attacks: Sequence[FoundAttack]) -> None:
        super().__init__()
        self._attacks = attacks
        self._number = -1
        self._world: World | None = None
        self._looks: dict[str, Appearance] = {}

    def world(self, number: int) -> World:
        """Return the world of an attack."""
        if self._world is None or self._number != number:
            self.close()
            attack = self._attacks[number]
            scenario = attack.scenario
            policy = scenario.policy.build(scenario.rig().views)
            world = build_world(scenario, policy)
            self._world, self._number = world, number
            self._looks = attack.looks(world)
        return self._world

    def drive(self, spec: DriveSpec, on_step: OnStep) -> Drive:
        """Drive once, the objects in their places."""
        batch, pose = spec.context
        world, column = self.world(batch.number), batch.column
        if batch.case != NO_OBJECT:
            look, errors = self._looks[batch.case], column.condition.errors
            offsets = errors.offsets(look.offsets, spec.seed)
            world.show(Appearance(look.textures, offsets))
        objects = [] if batch.case == NO_OBJECT else world.surrogate.objects
        key = batch.digest, spec.seed if column.serves_one_start else None
        environment = self.environment.get(
            key, lambda: column.open(world, objects, spec.seed)
        )
        return drive(
            environment,
            world.policy,
            world.route,
            pose=pose,
            seed=spec.seed,
            steps=spec.steps,
            on_step=on_step,
            case=batch.case,
            run=spec.run,
            label=spec.environment,
        )

    def close(self) -> None:
        """Close the environment, and forget the world."""
        super().close()
        self._world, self._looks = None, {}


def _decisive(attack: FoundAttack, column: Column, case: str) -> dict[str, str]:
    """Return what of a scenario, and of what was found, decides about drives."""
    inert: list[str] = []
    named = {}
    if case == NO_OBJECT:
        inert.append("objects")
    if case in (ATTACK, BEST_RANDOM):
        named["found"] = attack.digest
    if case == BEST_RANDOM:
        scenario = attack.scenario
        look = scenario.seed, scenario.baseline.kind, attack.best_random
        named["look"] = json.dumps(look)
    in_surrogate = column.environment == SURROGATE
    driven = decisive(attack.scenario, attack.identity, in_surrogate).items()
    return named | {k: value for k, value in driven if not is_within(k, inert)}
