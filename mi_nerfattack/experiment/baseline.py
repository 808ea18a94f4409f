"""Random appearances with an attack's budget, and the best of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.attack.black_box.random_looks import RandomLooks, equal_count, judge
from mi_nerfattack.backend.determinism import deterministic, one_thread
from mi_nerfattack.drives.run import OnSteps
from mi_nerfattack.drives.spec import short_digest
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import Effort
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.world import (
    Appearance,
    World,
    build_attack,
    build_world,
)
from mi_nerfattack.system.workers import (
    AbstractWork,
    AbstractWorkers,
    OnUnits,
    raise_failure,
    tally,
)

FORMAT = "mi_nerfattack judged look 1"


@dataclass(frozen=True, eq=False)
class RandomAppearances:
    """Random textures, poses, or both: whatever the attack may change.

    Attributes:
        looks: draws.
        own: the original appearance of the objects; parts that the attack may not
            change keep it.
    """

    looks: RandomLooks
    own: Appearance

    @classmethod
    def of(cls, world: World, own: Appearance) -> RandomAppearances:
        """Make the random appearances of a scenario."""
        scenario = world.scenario
        freedom, kind = scenario.attack.freedom.build(), scenario.baseline.kind
        return cls(RandomLooks(world.fields, freedom, kind, seed=scenario.seed), own)

    def __call__(self, number: int) -> Appearance:
        """Return an appearance by its number."""
        textures, offsets = self.looks.textures(number), self.looks.offsets(number)
        return Appearance(
            self.own.textures if textures is None else textures,
            self.own.offsets if offsets is None else offsets,
        )


class Judged(Record):
    """What the judgement of an appearance gave.

    Attributes:
        objective: the attack's.
        renders: frames that it took.
    """

    objective: float
    renders: int


class Judge:
    """What a process needs to judge random appearances.

    Each appearance is judged with the attack's objective and starting poses, by one
    drive. So :func:`equal_count` appearances cost as much as the attack.
    """

    def __init__(self, world: World, attack: AbstractAttack, own: Appearance) -> None:
        self._world, self._attack = world, attack
        self._looks = RandomAppearances.of(world, own)

    def judge(self, number: int, on_step: OnStep) -> Judged:
        """Judge an appearance."""
        world, attack, before = self._world, self._attack, self._world.renders
        world.show(self._looks(number))
        with deterministic(world.scenario.attack.deterministic):
            objective = judge(attack.rollout, attack.initial, on_step)
        return Judged(objective=objective, renders=world.renders - before)


@dataclass(frozen=True, eq=False)
class Judgements(AbstractWork):
    """Judgements of random appearances, one file each.

    Args:
        folder: of the files.
        identity: of the run.
        scenario: of the run.
        local_judge: the judge of this process; another process builds a judge.
    """

    folder: Path
    identity: Mapping[str, str]
    scenario: Scenario
    local_judge: Judge | None

    def open(self) -> Judge:
        """Build world and attack, unless they are there."""
        if self.local_judge is not None:
            return self.local_judge
        world = build_world(self.scenario, self.scenario.build_policy())
        return Judge(world, build_attack(world), world.appearance())

    def do(self, opened: Judge, index: int, report: OnUnits) -> None:
        """Judge one appearance; a unit is a control period."""
        with one_thread():
            judgement = opened.judge(index, lambda step: report(1))
        files.make_folder(self.folder)
        self._unit(index).write({}, judgement)

    def close(self, opened: Judge) -> None:
        """Let go of nothing."""
        del opened

    def read(self, number: int) -> Judged | None:
        """Read the judgement of an appearance; None where there is none."""
        stored = self._unit(number).read()
        return None if stored is None else stored.record

    def remove_others(self, count: int) -> None:
        """Remove files of other runs in the folder, and of further appearances."""
        expected = {self._unit(number).path for number in range(count)}
        for path in self.folder.glob("*.safetensors"):
            if path not in expected:
                path.unlink()

    def _unit(self, number: int) -> Unit[Judged]:
        identity = {"format": FORMAT, **self.identity, "look": f"{number}"}
        name = f"look_{number:04d}-{short_digest(identity)}.safetensors"
        return Unit(self.folder / name, identity, Judged, remedy="remove the file")

    def __getstate__(self) -> dict[str, Any]:
        """Leave the judge behind, whose world no process can send."""
        return {**self.__dict__, "local_judge": None}


@dataclass
class Baseline:
    """Random appearances that together cost as much as an attack, and both results.

    Attributes:
        attack: finished.
        looks: draws.
        count: number of random appearances.
        equal: number that costs as much as the attack.
        deployed: number of them that drive in each deployment.
        backward_multiple: cost of the attack's backward pass, in drives.
        objectives: of the random appearances, once they are judged.
    """

    attack: AbstractAttack
    looks: RandomAppearances
    count: int
    equal: int
    deployed: int
    backward_multiple: float
    objectives: list[float] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        world: World,
        original: Appearance,
        attack: AbstractAttack,
        effort: Effort,
    ) -> Baseline:
        """Make the baseline of a finished attack.

        Args:
            world: what the scenario describes.
            original: the original appearance of its objects.
            attack: finished.
            effort: its times give the cost of a backward pass. In a deterministic run,
                where no clock may decide anything, a backward pass costs one drive. A
                search has no backward pass, and it costs nothing.
        """
        section, strict = world.scenario.baseline, world.scenario.attack.deterministic
        is_timed = attack.sweeps > 1 and not strict
        multiple = effort.backward_multiple if is_timed else attack.sweeps - 1.0
        # A judgement renders as many frames as an iteration
        equal = equal_count(attack.iteration, multiple)
        count = section.textures or equal
        deployed = min(count, section.deployment_textures)
        looks = RandomAppearances.of(world, original)
        return cls(
            attack,
            looks,
            count,
            equal=equal,
            deployed=deployed,
            backward_multiple=multiple,
        )

    def judge(
        self,
        work: Judgements,
        workers: AbstractWorkers,
        progress: OnSteps,
        on_judged: Callable[[int], None],
    ) -> None:
        """Judge all random appearances, and find the best.

        Args:
            work: their judgements.
            workers: processes for the missing judgements.
            progress: called with control periods done and wanted.
            on_judged: called with the frames of each judgement.

        Raises:
            InputError: a file is damaged, or whatever a judgement raises.
        """
        horizon, numbers = self.attack.rollout.horizon, range(self.count)
        left = [number for number in numbers if work.read(number) is None]
        done = (self.count - len(left)) * horizon

        def on_end(number: int, error: Exception | None) -> None:
            raise_failure(number, error)
            on_judged(self._read(work, number).renders)

        count = tally(progress, done, self.count * horizon)
        workers.run(work, left, count, on_end)
        work.remove_others(self.count)
        self.objectives = [self._read(work, number).objective for number in numbers]

    def _read(self, work: Judgements, number: int) -> Judged:
        if (judgement := work.read(number)) is None:
            raise InputError(f"{work.folder}: look {number} is missing; it was removed")
        return judgement

    @property
    def best(self) -> int:
        """Number of the appearance with the least objective, the worst one to drive."""
        return int(np.argmin(self.objectives))

    def figures(self) -> dict[str, Any]:
        """Return what ``metrics.json`` holds of the baseline."""
        return {
            "textures": self.count,
            "equal_textures": self.equal,
            "deployment_textures": self.deployed,
            "backward_multiple": self.backward_multiple,
            "best": self.best,
            "objectives": self.objectives,
            "attack_objective": float(self.attack.judged_objective),
        }
