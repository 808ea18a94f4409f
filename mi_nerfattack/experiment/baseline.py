"""Random looks of an attack's cost, the best of them, and what became of both."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.attack.black_box.random_looks import RandomLooks, equal_count, judge
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.stages import Stages
from mi_nerfattack.rollout.drive import BEST_RANDOM, RANDOM
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World


@dataclass
class Baseline:
    """Random textures, poses, or both: whatever the attack may change.

    Each is judged as the attack judges its own, from the poses that it starts from:
    by one drive, so that as many as :func:`baseline.equal_count` cost what it does.

    Attributes:
        attack: finished.
        looks: draws.
        original: how the objects look and stand by themselves.
        count: of looks.
        deployed: of them, driven with in each deployment.
        backward_multiple: cost of the attack's pass back, in drives.
        objectives: of the looks, once they are judged.
    """

    attack: AbstractAttack
    looks: RandomLooks
    original: Appearance
    count: int
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
            original: how its objects look and stand by themselves.
            attack: finished.
            effort: tells the cost of a pass back; in a deterministic run, where no
                clock may decide anything, it counts as one drive, and of a search,
                which makes none, as nothing.
        """
        scenario = world.scenario
        section, strict = scenario.baseline, scenario.attack.deterministic
        is_timed = attack.sweeps > 1 and not strict
        multiple = effort.backward_multiple if is_timed else attack.sweeps - 1.0
        drives = attack.iteration * attack.rollout.frames / attack.rollout.horizon
        count = section.textures or equal_count(drives, multiple)
        deployed = min(count, section.deployment_textures)
        draws = world.fields, attack.freedom, section.kind, scenario.seed
        looks = RandomLooks(*draws)
        return cls(attack, looks, original, count, deployed, multiple)

    def look(self, number: int) -> Appearance:
        """Return a random look; what the attack may not change is the objects' own."""
        return random_appearance(self.looks, number, self.original)

    def drive(self, stages: Stages) -> None:
        """Judge and drive all looks in the surrogate, and find the best."""
        attack = self.attack
        found = stages.drive_random(
            SURROGATE,
            self.count,
            self.look,
            lambda on_step: judge(attack.rollout, attack.initial, on_step),
        )
        self.objectives = [value for value in found if value is not None]
        stages.looks |= {RANDOM: self.look(0), BEST_RANDOM: self.look(self.best)}

    @property
    def best(self) -> int:
        """Number of the look with the least objective: the worst for the policy."""
        return int(np.argmin(self.objectives))

    def figures(self) -> dict[str, Any]:
        """Return what ``metrics.json`` tells of it."""
        return {
            "textures": self.count,
            "deployment_textures": self.deployed,
            "backward_multiple": self.backward_multiple,
            "best": self.best,
            "objectives": self.objectives,
            "attack_objective": float(self.attack.best_objective),
        }


def random_appearance(looks: RandomLooks, number: int, own: Appearance) -> Appearance:
    """Return a random look.

    Args:
        looks: draws.
        number: of the look.
        own: the objects' own; what an attack may not change stays like that.
    """
    textures, offsets = looks.textures(number), looks.offsets(number)
    return Appearance(
        own.textures if textures is None else textures,
        own.offsets if offsets is None else offsets,
    )
