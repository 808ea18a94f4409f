"""The drives of a run, each done once, however often the run is interrupted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mi_nerfattack.deploy.driving import drive
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.kept_drives import KeptDrives
from mi_nerfattack.fields.random_textures import random_texture
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import World

#: Called with stage, steps done, steps in all, and a remark.
OnProgress = Callable[[str, int, int, str], None]


@dataclass
class Stages:
    """Drives through a world, keeping each on disk as it ends.

    One environment is open at a time.

    Attributes:
        world: fields, environments, policy.
        kept: drives that are finished.
        on_progress: told about every time step.
        effort: tells what the run has cost so far.
        drives: all drives that were asked for so far.
        renders: frames of environments that are not the surrogate.
    """

    world: World
    kept: KeptDrives
    on_progress: OnProgress
    effort: Callable[[], Effort]
    drives: list[Drive] = field(default_factory=list)
    renders: int = 0
    _opened: tuple[object, AbstractEnvironment] | None = None

    def drive_all(self, label: str, case: str) -> None:
        """Drive from all initial states, objects as they are; once where it is open.

        Args:
            label: of the environment.
            case: of the drives.
        """
        count = 1 if self.world.is_open_loop(label) else len(self.world.initial)
        for run in range(count):
            if not self._take(label, case, run, count):
                self._drive(label, case, run, count, (label, case))

    def drive_random(self, label: str) -> None:
        """Drive with random textures, each from one of the initial states."""
        scenario = self.world.scenario
        count = scenario.baseline.textures or scenario.attack.iterations
        for run in range(count):
            if not self._take(label, "random", run, count):
                self._set_random_textures(run)
                self._drive(label, "random", run, count, (label, run))

    def close(self) -> None:
        """Close the environment that is open."""
        if self._opened is not None:
            self._opened[1].close()
        self._opened = None

    def _set_random_textures(self, k: int) -> None:
        scenario, fields = self.world.scenario, self.world.fields
        sequence = np.random.SeedSequence([scenario.seed, 1, k])
        seeds = sequence.generate_state(len(fields))
        kind = scenario.baseline.kind
        self.world.set_textures(
            [
                random_texture(grid, kind, int(seed))
                for grid, seed in zip(fields, seeds, strict=True)
            ]
        )

    def _take(self, label: str, case: str, run: int, count: int) -> bool:
        """Take up a drive that is finished; False if it is not."""
        found = self.kept.take(label, case, run)
        if found is None:
            return False
        horizon = self.world.scenario.drive.horizon
        done, total = (run + 1) * horizon, count * horizon
        self.on_progress(f"{label}: {case}", done, total, "kept")
        self.drives.append(found)
        return True

    def _drive(self, label: str, case: str, run: int, count: int, look: object) -> None:
        """Drive once, and keep the drive."""
        world, scenario = self.world, self.world.scenario
        horizon = scenario.drive.horizon

        def on_step(step: int) -> None:
            done = run * horizon + step + 1
            self.on_progress(f"{label}: {case}", done, count * horizon, "")

        found = drive(
            self._environment(label, look),
            world.policy,
            world.route,
            world.initial[run % len(world.initial)],
            scenario.seed + run,
            horizon,
            on_step,
            case,
            run,
            label,
        )
        self.renders += 0 if label == SURROGATE else len(found.states)
        self.kept.add(found, self.effort())
        self.drives.append(found)

    def _environment(self, label: str, look: object) -> AbstractEnvironment:
        """Open an environment, unless it is; another look may need another one."""
        key = look if self.world.builds_in(label) else label
        if self._opened is None or self._opened[0] != key:
            self.close()
            self._opened = key, self.world.open(label)
        return self._opened[1]
