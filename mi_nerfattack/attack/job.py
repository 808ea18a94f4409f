"""The main job: drives, random baseline, attack, transfer, run folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack import files
from mi_nerfattack.attack.checkpoint import (
    check_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.results import write_results
from mi_nerfattack.attack.setup import build_attack
from mi_nerfattack.attack.textures import random_texture
from mi_nerfattack.attack.world import (
    World,
    build_world,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.memory import peak_memory_mb
from mi_nerfattack.report.metrics import Drive, departure_limit
from mi_nerfattack.rollout.loop import simulate
from mi_nerfattack.rollout.sensor import AbstractSensor
from mi_nerfattack.scenario import Scenario, portable_text

CHECKPOINT = "checkpoint.safetensors"
SCENARIO = "scenario.toml"

#: Called with stage, steps done, steps in all, and a remark.
OnProgress = Callable[[str, int, int, str], None]


def _quiet(stage: str, done: int, total: int, remark: str) -> None:
    del stage, done, total, remark


@dataclass
class Job:
    """One scenario on its way through all stages.

    Attributes:
        scenario: what to do.
        text: the scenario file, kept in the run folder.
        base: folder that the scenario's relative paths start from.
        policy: the policy under test.
        output: the run folder.
        on_progress: told about every time step.
    """

    scenario: Scenario
    text: str
    base: Path
    policy: Any
    output: Path
    on_progress: OnProgress = _quiet
    drives: list[Drive] = field(default_factory=list)

    def run(self, resume: bool = False) -> dict[str, Any]:
        """Do the whole job and write the run folder.

        Args:
            resume: continue the attack from the folder's checkpoint.

        Returns:
            the document that ``metrics.json`` holds.

        Raises:
            InputError: a file is missing or wrong, the folder is not empty, or it
                holds a checkpoint of another scenario.
        """
        started = time.perf_counter()
        self._check_folder(resume)
        world = build_world(self.scenario, self.base, self.policy)
        departure_limit(world.route.lane_width_m, self.scenario.vehicle.width_m)
        digest = self.scenario.digest(self.base)
        checkpoint = self.output / CHECKPOINT
        resume = resume and checkpoint.is_file()
        if resume:
            check_checkpoint(checkpoint, digest)
        else:
            files.make_folder(self.output)
            text = portable_text(self.text, self.base)
            files.write_text(self.output / SCENARIO, text)
        original = [grid.texture.numpy().copy() for grid in world.fields]
        self._drive_all(world, world.surrogate, "unperturbed")
        self._random(world, world.surrogate)
        world.set_textures(original)
        attack = self._attack(world, digest, resume)
        attacked = attack.best
        self._drive_all(world, world.surrogate, "gradient")
        world.set_textures(original)
        self._drive_all(world, world.deployment, "unperturbed")
        self._random(world, world.deployment)
        world.set_textures(attacked)
        self._drive_all(world, world.deployment, "gradient")
        cost = {
            "wall_s": time.perf_counter() - started,
            "peak_memory_mb": peak_memory_mb(),
            "renders": world.surrogate.renders + world.deployment.renders,
        }
        textures = {"unperturbed": original, "gradient": attacked}
        on_step = self._counter(
            "surrogate: attribution", 3 * self.scenario.drive.horizon
        )
        return write_results(
            self.output, world, self.drives, attack, textures, self.text, cost, on_step
        )

    def _counter(self, stage: str, total: int) -> Callable[[int], None]:
        """Report the progress of a stage each time that the result is called."""
        done = 0

        def on_step(step: int) -> None:
            nonlocal done
            del step
            done += 1
            self.on_progress(stage, done, total, "")

        return on_step

    def _check_folder(self, resume: bool) -> None:
        """Refuse a folder that holds something else; nothing is written."""
        if resume:
            if not (self.output / SCENARIO).is_file():
                raise InputError(
                    f"{self.output}: is no run folder; there is nothing to resume"
                )
        elif self.output.exists():
            if not self.output.is_dir() or any(self.output.iterdir()):
                raise InputError(
                    f"{self.output}: exists and is not an empty folder; choose "
                    "another, or continue with --resume"
                )

    def _drive_all(self, world: World, sensor: AbstractSensor, case: str) -> None:
        """Drive all initial states as one batch."""
        stage = f"{_environment(world, sensor)}: {case}"
        self._drive(world, sensor, case, world.initial, 0, stage)

    def _drive(
        self,
        world: World,
        sensor: AbstractSensor,
        case: str,
        initial: np.ndarray,
        first_run: int,
        stage: str,
    ) -> None:
        horizon = self.scenario.drive.horizon
        count = self._random_count if case == "random" else 1

        def on_step(step: int) -> None:
            done = first_run * horizon + step + 1
            self.on_progress(stage, done, count * horizon, "")

        loop = world.loop(sensor)
        drive = simulate(loop, loop.initial(initial), horizon, on_step)
        states, controls = drive.states_numpy(), drive.controls_numpy()
        for i in range(len(initial)):
            self.drives.append(
                Drive(
                    environment=_environment(world, sensor),
                    route=world.route.name,
                    case=case,
                    run=first_run + i,
                    seed=self.scenario.seed,
                    states=states[i],
                    controls=controls[i],
                    cross_track_m=world.route.cross_track_numpy(states[i, 1:]),
                    time_s=self.scenario.vehicle.dt_s * np.arange(1, horizon + 1),
                )
            )

    @property
    def _random_count(self) -> int:
        return self.scenario.baseline.textures or self.scenario.attack.iterations

    def _random(self, world: World, sensor: AbstractSensor) -> None:
        """Drive with random textures, each from one of the initial states."""
        stage = f"{_environment(world, sensor)}: random"
        for k in range(self._random_count):
            world.set_textures(
                [
                    random_texture(grid, self.scenario.baseline.kind, seed)
                    for grid, seed in zip(
                        world.fields, self._texture_seeds(world, k), strict=True
                    )
                ]
            )
            initial = world.initial[k % len(world.initial)][None]
            self._drive(world, sensor, "random", initial, k, stage)

    def _texture_seeds(self, world: World, k: int) -> list[int]:
        sequence = np.random.SeedSequence([self.scenario.seed, 1, k])
        return [int(s) for s in sequence.generate_state(len(world.fields))]

    def _attack(self, world: World, digest: str, resume: bool) -> GradientAttack:
        section = self.scenario.attack
        attack = build_attack(world, self.base)
        path = self.output / CHECKPOINT
        if resume:
            load_checkpoint(path, attack, digest)
        try:
            while attack.iteration < section.iterations:
                self._iterate(attack)
                if attack.iteration % section.checkpoint_every == 0:
                    save_checkpoint(path, attack, digest)
        finally:
            if attack.iteration:
                save_checkpoint(path, attack, digest)
        attack.measure()
        attack.restore_best()
        return attack

    def _iterate(self, attack: GradientAttack) -> None:
        horizon = self.scenario.drive.horizon
        total = 2 * horizon * self.scenario.attack.iterations
        done = 2 * horizon * attack.iteration
        remark = f"iteration {attack.iteration + 1}"
        if attack.history:
            mean = attack.history[-1].cross_track_mean_m
            remark += f", |e| {mean:.3f} m (best {attack.best_mean_m:.3f})"

        def on_step(step: int) -> None:
            nonlocal done
            del step
            done += 1
            self.on_progress("surrogate: attack", done, total, remark)

        attack.step(on_step)


def _environment(world: World, sensor: AbstractSensor) -> str:
    return "surrogate" if sensor is world.surrogate else "deployment"
