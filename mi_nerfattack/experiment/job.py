"""The main job: drives, random baseline, attack, transfer, run folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.backend import variant
from mi_nerfattack.backend.determinism import deterministic, one_thread
from mi_nerfattack.backend.interrupts import held_interrupts
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.errors import InputError, RefusedError
from mi_nerfattack.experiment.baseline import Baseline
from mi_nerfattack.experiment.checks.before_attack import (
    first_findings,
    further_findings,
)
from mi_nerfattack.experiment.claim import claimed
from mi_nerfattack.experiment.effort import Account, Effort
from mi_nerfattack.experiment.finished import Finished, Frames
from mi_nerfattack.experiment.kept_drives import SharedDrives
from mi_nerfattack.experiment.run_folder import Run, RunFolder
from mi_nerfattack.experiment.stages import OnProgress, Stages, step_counter
from mi_nerfattack.rollout.drive import (
    ATTACK,
    BEST_RANDOM,
    NO_OBJECT,
    OWN,
    departure_limit,
)
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.scenario import Scenario, load_scenario, portable_text
from mi_nerfattack.scenario.world import World, build_attack, build_world
from mi_nerfattack.scenes import resolve

#: Called with a sentence.
OnNotice = Callable[[str], None]


def quiet(*arguments: Any) -> None:
    """Show nothing of what is reported."""
    del arguments


def _is_of_disk(error: BaseException | None) -> bool:
    """Tell an error that no other scenario mends, such as a full disk."""
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__
    return error is not None


@dataclass
class Job:
    """One scenario on its way through all stages.

    Attributes:
        scenario: what to do.
        text: the scenario file, kept in the run folder.
        policy: the policy under test.
        output: the run folder.
        on_progress: told about every time step.
        on_notice: told what a run that goes on ignores.
        started: `time.perf_counter()` from which the wall time counts.
        frames: of each case, see ``pictures.frames.frame_steps``; None writes no
            pictures at all: no frames, plots, attribution and page.
        shared: drives that other runs have in common with this one, if any.
    """

    scenario: Scenario
    text: str
    policy: Any
    output: Path
    on_progress: OnProgress = quiet
    on_notice: OnNotice = quiet
    started: float = field(default_factory=time.perf_counter)
    frames: Frames | None = 3
    shared: SharedDrives | None = None

    def run(self, force: bool = False, anyway: bool = False) -> dict[str, Any]:
        """Claim the run folder and do the whole job; see :meth:`run_claimed`."""
        with claimed(self.output):
            return self.run_claimed(force, anyway)

    def run_claimed(self, force: bool = False, anyway: bool = False) -> dict[str, Any]:
        """Do the whole job and write the run folder, which is claimed.

        It goes on from what an interrupted run left in the folder. A scenario that is
        refused before its first iteration leaves nothing there.

        Args:
            force: go on although scenario, files or versions have changed: the
                attack goes on, the drives are repeated.
            anyway: go on with a scenario whose attack would prove nothing; what was
                found stands under ``flags`` in the document.

        Returns:
            the document that ``metrics.json`` holds.

        Raises:
            InputError: a file is missing or wrong, or the run in the folder is damaged,
                or of another scenario or versions.
            RefusedError: the attack would prove nothing.
            SetupError: the scenario is deterministic and the variant cannot be.
        """
        identity = {**versions(), **self.scenario.identity()}
        text = portable_text(self.scenario, self.text)
        route, seed = self.scenario.scene.route, self.scenario.seed
        strict = self.scenario.attack.deterministic
        folder = RunFolder(self.output, text, identity, route, seed)
        with deterministic() if strict else nullcontext():
            folder.read(force, self.on_notice)
            world = build_world(self.scenario, self.policy)
            departure_limit(world.route.lane_width_m, self.scenario.vehicle.width_m)
            for label in world.labels:  # what cannot be made is told before hours
                world.open(label).close()
            folder.begin()
            try:
                account = Account(self.started, folder.effort)
                return self._work(world, folder, account, anyway)
            except InputError as err:
                if not _is_of_disk(err):
                    folder.withdraw()
                raise

    def _work(
        self, world: World, folder: RunFolder, account: Account, anyway: bool
    ) -> dict[str, Any]:
        """Do what is not done yet."""

        def effort() -> Effort:
            renders = world.renders + stages.renders
            return account.total(renders, folder.checkpoint.seconds)

        kept, told = folder.drives, self.on_progress
        stages = Stages(world, kept, told, effort, self.shared)
        stages.looks[OWN] = original = world.appearance()
        with closing(stages):
            flags = self._check(world, folder, stages, anyway)
            for case in (NO_OBJECT, OWN):
                stages.drive_all(SURROGATE, case)
            attack = self._attack(world, folder, account, effort)
            stages.looks[ATTACK] = world.appearance()
            baseline = Baseline.of(world, original, attack, effort())
            baseline.drive(stages)
            for case in (BEST_RANDOM, ATTACK):
                stages.drive_all(SURROGATE, case)
            for label in world.deployments:
                for case in (NO_OBJECT, OWN):
                    stages.drive_all(label, case)
                stages.drive_random(label, baseline.deployed, baseline.look)
                for case in (BEST_RANDOM, ATTACK):
                    stages.drive_all(label, case)
        from mi_nerfattack.experiment import results  # it loads the plots

        done = Finished(
            world,
            stages.drives,
            attack,
            stages.looks,
            folder.checkpoint.ignored,
            baseline.figures(),
            flags,
        )
        how = self.on_progress, self.on_notice, self.frames
        return results.write_results(self.output, done, effort, *how)

    def _check(
        self, world: World, folder: RunFolder, stages: Stages, anyway: bool
    ) -> list[str]:
        """Return what makes the attack worthless, unless it was allowed before."""
        if folder.checkpoint.flags is not None:
            return folder.checkpoint.flags
        flags: list[str] = []
        for check in (first_findings, further_findings):
            flags += check(world, stages.one)
            if flags and not anyway:
                listed = "\n".join(f"  {line}" for line in flags)
                raise RefusedError(
                    f"an attack would prove nothing:\n{listed}\nmend the scenario, or "
                    "attack all the same (--anyway)"
                )
        for line in flags:
            self.on_notice(f"warning: {line}")
        folder.checkpoint.flags = flags
        return flags

    def _attack(
        self,
        world: World,
        folder: RunFolder,
        account: Account,
        effort: Callable[[], Effort],
    ) -> AbstractAttack:
        """Do the iterations that are missing; whatever stops them, keep those done."""
        attack = build_attack(world)
        section, checkpoint = self.scenario.attack, folder.checkpoint
        if checkpoint.found:
            checkpoint.restore(attack)
        if not attack.best_is_judged:
            stage = "surrogate: best so far"
            attack.judge_best(step_counter(self.on_progress, stage, world.horizon))
            checkpoint.save(attack, effort())
        try:
            with held_interrupts() as check:
                while not attack.is_over:
                    self._iterate(attack, account, check)
                    if attack.iteration % section.checkpoint_every == 0:
                        checkpoint.save(attack, effort())
                    check()
        finally:
            done = attack.iteration > checkpoint.iteration
            if done and attack.whole and not checkpoint.failed:
                checkpoint.save(attack, effort())
        attack.finish()
        return attack

    def _iterate(
        self, attack: AbstractAttack, account: Account, check: Callable[[], None]
    ) -> None:
        horizon = attack.rollout.horizon
        section, frames = self.scenario.attack, horizon * self.scenario.attack.poses
        total = attack.sweeps * horizon * section.method.iterations(frames)
        done = attack.sweeps * horizon * attack.iteration
        remark = f"iteration {attack.iteration + 1}"
        if attack.history:
            mean = attack.history[-1].cross_track_mean_m
            remark += f", |e| {mean:.3f} m (best {attack.best_mean_m:.3f})"

        def on_step(step: int) -> None:
            nonlocal done
            del step
            done += 1
            if done % horizon == 0:  # there; back, if it goes back
                times.append(time.perf_counter())
            self.on_progress("surrogate: optimisation", done, total, remark)
            check()

        times = [time.perf_counter()]
        attack.step(on_step)
        sweeps = np.diff(times)
        account.add_iteration(float(sweeps[::2].sum()), float(sweeps[1::2].sum()))


def attack_policy(
    scenario: str | Path,
    folder: str | Path,
    *,
    force: bool = False,
    anyway: bool = False,
    frames: Frames | None = 3,
    progress: OnProgress = quiet,
    on_notice: OnNotice = quiet,
) -> Run:
    """Attack a policy as a scenario file describes it: ``mi-nerfattack attack``.

    Args:
        scenario: TOML file, or ``bundled:FILE``.
        folder: the run folder: new, or of the same attack, which then goes on.
        force: go on although scenario, files or versions have changed.
        anyway: attack although the checks find that it would prove nothing.
        frames: of each case: ``"all"``, ``"worst"``, or so many, equally spaced; None
            writes no frames, plots, attribution and page.
        progress: called with stage, steps done, steps in all and a remark, for example
            `mi_nerfattack.progress()`.
        on_notice: called with a sentence, for example `print`.

    Raises:
        InputError: a file is missing or wrong, or the attack would prove nothing.
        SetupError: the scenario is deterministic and the variant cannot be.
    """
    started, output = time.perf_counter(), Path(folder)
    with claimed(output):
        metrics = attack_claimed(
            resolve(str(scenario)),
            output,
            started=started,
            frames=frames,
            on_progress=progress,
            on_notice=on_notice,
            force=force,
            anyway=anyway,
        )
    return Run(output, metrics)


def attack_claimed(
    scenario: Path,
    folder: Path,
    *,
    object_field: Path | None = None,
    started: float,
    frames: Frames | None,
    on_progress: OnProgress,
    on_notice: OnNotice,
    force: bool,
    anyway: bool,
) -> dict[str, Any]:
    """Do what :func:`attack_policy` does in a folder that is claimed.

    Args:
        scenario: the scenario file.
        folder: the run folder.
        object_field: grid field that replaces the one of every object.
        started: `time.perf_counter()` from which the wall time counts.
        frames: as of :func:`attack_policy`.
        on_progress: called with stage, steps done, steps in all and a remark.
        on_notice: called with a sentence.
        force: as of :func:`attack_policy`.
        anyway: as of :func:`attack_policy`.

    Returns:
        the document that ``metrics.json`` holds.
    """
    described, text = load_scenario(scenario, object_field)
    variant.ensure()
    policy = described.build_policy()
    with one_thread():
        reports = on_progress, on_notice
        job = Job(described, text, policy, folder, *reports, started, frames)
        return job.run_claimed(force, anyway)
