"""The drives of a run, each done once, however often the run is interrupted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.kept_drives import KeptDrives
from mi_nerfattack.fields.random_textures import random_texture
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.rollout.loop import Trajectory, simulate
from mi_nerfattack.rollout.sensor import AbstractSensor
from mi_nerfattack.scenario.world import World

#: Called with stage, steps done, steps in all, and a remark.
OnProgress = Callable[[str, int, int, str], None]


@dataclass
class Stages:
    """Drives through a world, keeping each batch on disk as it ends.

    Attributes:
        world: fields, sensors, policy.
        kept: drives that are finished.
        on_progress: told about every time step.
        effort: tells what the run has cost so far.
        drives: all drives that were asked for so far.
    """

    world: World
    kept: KeptDrives
    on_progress: OnProgress
    effort: Callable[[], Effort]
    drives: list[Drive] = field(default_factory=list)

    @property
    def random_count(self) -> int:
        """Number of random textures."""
        scenario = self.world.scenario
        return scenario.baseline.textures or scenario.attack.iterations

    def drive_all(self, sensor: AbstractSensor, case: str) -> None:
        """Drive all initial states as one batch, with the textures as they are."""
        self._drive(sensor, case, self.world.initial, 0, 1)

    def drive_random(self, sensor: AbstractSensor) -> None:
        """Drive with random textures, each from one of the initial states."""
        initial, count = self.world.initial, self.random_count
        for k in range(count):
            if not self._take(sensor, "random", range(k, k + 1), count):
                self._set_random_textures(k)
                state = initial[k % len(initial)][None]
                self._drive(sensor, "random", state, k, count)

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

    def _take(
        self, sensor: AbstractSensor, case: str, runs: range, batches: int
    ) -> bool:
        """Take up drives that are finished; False if they are not."""
        found = self.kept.take(self._environment(sensor), case, runs)
        if found is None:
            return False
        horizon = self.world.scenario.drive.horizon
        done = runs.stop if case == "random" else 1
        stage = f"{self._environment(sensor)}: {case}"
        self.on_progress(stage, done * horizon, batches * horizon, "kept")
        self.drives += found
        return True

    def _drive(
        self,
        sensor: AbstractSensor,
        case: str,
        initial: np.ndarray,
        first_run: int,
        batches: int,
    ) -> None:
        """Drive a batch unless it is finished already."""
        runs = range(first_run, first_run + len(initial))
        if self._take(sensor, case, runs, batches):
            return
        horizon = self.world.scenario.drive.horizon
        stage = f"{self._environment(sensor)}: {case}"

        def on_step(step: int) -> None:
            done = first_run * horizon + step + 1
            self.on_progress(stage, done, batches * horizon, "")

        loop = self.world.loop(sensor)
        trajectory = simulate(loop, loop.initial(initial), horizon, on_step)
        drives = self._records(trajectory, self._environment(sensor), case, first_run)
        self.kept.add(drives, self.effort())
        self.drives += drives

    def _records(
        self, trajectory: Trajectory, environment: str, case: str, first_run: int
    ) -> list[Drive]:
        states = trajectory.states_numpy()[..., :3]  # vehicles may have more
        controls = trajectory.controls_numpy()
        world = self.world
        common: dict[str, Any] = {
            "environment": environment,
            "route": world.route.name,
            "case": case,
            "seed": world.scenario.seed,
            "time_s": world.scenario.vehicle.dt_s
            * np.arange(1, trajectory.horizon + 1),
        }
        return [
            Drive(
                run=first_run + i,
                states=states[i],
                controls=controls[i],
                cross_track_m=world.route.cross_track_numpy(states[i, 1:]),
                **common,
            )
            for i in range(len(states))
        ]

    def _environment(self, sensor: AbstractSensor) -> str:
        return "surrogate" if sensor is self.world.surrogate else "deployment"
