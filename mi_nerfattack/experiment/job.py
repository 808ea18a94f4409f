"""The main job: drives, random baseline, attack, transfer, run folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.backend import variant
from mi_nerfattack.backend.determinism import deterministic, one_thread
from mi_nerfattack.backend.interrupts import held_interrupts
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.drives.spec import DriveSpec
from mi_nerfattack.errors import InputError, RefusedError, is_of_disk
from mi_nerfattack.experiment.baseline import Baseline, Judge, Judgements
from mi_nerfattack.experiment.cases import (
    Cases,
    OnProgress,
    scenario_workers,
    step_counter,
)
from mi_nerfattack.experiment.checks import before_attack
from mi_nerfattack.experiment.claim import LOOKS, claimed
from mi_nerfattack.experiment.finished import Finished, Frames, Run
from mi_nerfattack.experiment.run_folder import Account, Effort, RunFolder
from mi_nerfattack.extras import require
from mi_nerfattack.rollout.drive import (
    ATTACK,
    BEST_RANDOM,
    NO_OBJECT,
    OWN,
    RANDOM,
    departure_limit,
)
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.named_file import portable_text
from mi_nerfattack.scenario.scenario import Scenario, is_within, load_scenario
from mi_nerfattack.scenario.world import World, build_attack, build_world
from mi_nerfattack.scenes import resolve
from mi_nerfattack.system.workers import AbstractWorkers, InThisProcess

#: Called with a sentence.
OnNotice = Callable[[str], None]


#: Parts of a scenario that have no part in the judgement of a random look.
_NOT_JUDGED = (
    *("name", "deployment", "scene.deployment", "drive.runs", "baseline"),
    *("attack.method", "attack.checkpoint_every"),
)
_JUDGED_BY = ("attack.method.kind", "attack.method.frame", "baseline.kind")


def quiet(*arguments: Any) -> None:
    """Show nothing of what is reported."""
    del arguments


@dataclass
class Job:
    """One scenario on its way through all stages.

    Attributes:
        scenario: what to do.
        text: the scenario file, kept in the run folder.
        policy: the policy under test.
        output: the run folder.
        on_progress: called after every time step with stage, steps and a remark.
        on_notice: called with a sentence, such as what a continued run ignores.
        started: `time.perf_counter()` from which the wall time counts.
        frames: of each case, see ``pictures.frames.frame_steps``; None writes no
            frames, plots, attribution and page.
        shared: folder of drives that other runs have in common with this one, if any.
        workers: who does the drives.
    """

    scenario: Scenario
    text: str
    policy: Any
    output: Path
    on_progress: OnProgress = quiet
    on_notice: OnNotice = quiet
    started: float = field(default_factory=time.perf_counter)
    frames: Frames | None = 3
    shared: Path | None = None
    workers: AbstractWorkers = field(default_factory=InThisProcess)

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
                attack goes on; drives that are other ones now are repeated.
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
        described = self.scenario.identity()
        identity = {**versions(), **described}
        text = portable_text(self.scenario, self.text)
        strict = self.scenario.attack.deterministic
        folder = RunFolder(self.output, text, identity, shared=self.shared)
        with deterministic(strict):
            folder.read(force, self.on_notice)
            world = build_world(self.scenario, self.policy)
            departure_limit(world.route.lane_width_m, self.scenario.vehicle.width_m)
            for label in world.labels:  # what cannot be made is told before hours
                world.open(label).close()
            folder.begin()
            try:
                account = Account(self.started, folder.effort)
                return self._work(world, folder, account, described, anyway)
            except InputError as err:
                if not is_of_disk(err):
                    folder.withdraw()
                raise

    def _work(
        self,
        world: World,
        folder: RunFolder,
        account: Account,
        described: Mapping[str, str],
        anyway: bool,
    ) -> dict[str, Any]:
        """Do what is not done yet."""

        def effort() -> Effort:
            renders = world.renders + cases.renders
            return account.total(renders, folder.checkpoint.seconds)

        def save() -> None:
            folder.save(effort())

        cases = Cases(world, folder.drives, described, self.on_progress, save)
        with closing(cases):
            flags = self._check(world, folder, cases, anyway)
            attack = self._attack(world, folder, account, save)
            cases.looks[ATTACK] = world.appearance()
            baseline = Baseline.of(world, cases.own, attack, effort=effort())
            self._judge(baseline, folder, cases)
            specs = list(self._specs(cases, baseline))
            drives = cases.drive(specs, self.workers)
        folder.drives.remove_others(specs)
        from mi_nerfattack.experiment import results  # it loads the plots

        done = Finished(
            world,
            drives,
            attack,
            looks=cases.looks,
            ignored=folder.checkpoint.ignored,
            baseline=baseline.figures(),
            flags=flags,
        )
        return results.write_results(
            self.output, done, effort, self.on_progress, self.on_notice, self.frames
        )

    def _judge(self, baseline: Baseline, folder: RunFolder, cases: Cases) -> None:
        """Judge random looks, and find the best."""
        scenario, judge = self.scenario, Judge(cases.world, baseline.attack, cases.own)
        decisive = {
            key: value
            for key, value in folder.identity.items()
            if is_within(key, _JUDGED_BY) or not is_within(key, _NOT_JUDGED)
        }
        work = Judgements(folder.path / LOOKS, decisive, scenario, judge)

        def progress(done: int, total: int) -> None:
            self.on_progress("surrogate: random textures", done, total, "")

        baseline.judge(work, self.workers, progress, cases.counter())
        cases.looks[RANDOM] = baseline.looks(0)
        cases.looks[BEST_RANDOM] = baseline.looks(baseline.best)

    def _specs(self, cases: Cases, baseline: Baseline) -> Iterator[DriveSpec]:
        """Describe all drives of the run."""
        for label in cases.world.labels:
            count = baseline.count if label == SURROGATE else baseline.deployed
            for case in (NO_OBJECT, OWN):
                yield from cases.of_case(label, case)
            yield from cases.of_random(label, count)
            for case in (BEST_RANDOM, ATTACK):
                yield from cases.of_case(label, case)

    def _check(
        self, world: World, folder: RunFolder, cases: Cases, anyway: bool
    ) -> list[str]:
        """Return what makes the attack worthless, unless it was allowed before."""
        if folder.checkpoint.flags is not None:
            return folder.checkpoint.flags
        flags: list[str] = []
        for check in (before_attack.first_findings, before_attack.further_findings):
            flags += check(world, cases.one)
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
        save: Callable[[], None],
    ) -> AbstractAttack:
        """Do the iterations that are missing; whatever stops them, keep those done."""
        attack = build_attack(world)
        section, checkpoint = self.scenario.attack, folder.checkpoint
        if checkpoint.is_loaded:
            checkpoint.restore(attack)
        if not attack.best_is_judged:
            stage = "surrogate: best so far"
            attack.judge_best(step_counter(self.on_progress, stage, world.horizon))
            checkpoint.save(attack)
            save()
        try:
            with held_interrupts() as check:
                while not attack.is_over:
                    self._iterate(attack, account, check)
                    if attack.iteration % section.checkpoint_every == 0:
                        checkpoint.save(attack)
                        save()
                    check()
        finally:
            done = attack.iteration > checkpoint.iteration
            if done and attack.is_consistent and not checkpoint.failed:
                checkpoint.save(attack)
                save()
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
        if len(attack.without_gradient) == len(attack.sensor.objects):
            raise InputError(
                f"attack iteration {attack.iteration}: the gradient is exactly 0, so "
                "nothing would change; no object is in view, or the control has no "
                "slope by the image (torch.round, a clamp at its limit): smooth it, or "
                'give attack.method.kind = "blocks", which needs no gradient'
            )


def attack_policy(
    scenario: str | Path,
    folder: str | Path,
    *,
    force: bool = False,
    anyway: bool = False,
    frames: Frames | None = 3,
    workers: int = 1,
    settings: Sequence[str] = (),
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
        workers: processes that drive. A script that takes more than 1 needs
            ``if __name__ == "__main__":``, as with `multiprocessing`.
        settings: keys that replace those of the file, such as ``"drive.runs=4"``.
        progress: called with stage, steps done, steps in all and a remark, for example
            `mi_nerfattack.progress()`.
        on_notice: called with a sentence, for example `print`.

    Raises:
        InputError: a file is missing or wrong, or the attack would prove nothing.
        SetupError: the scenario is deterministic and the variant cannot be.
    """
    started, output = time.perf_counter(), Path(folder)
    with claimed(output):
        attack_claimed(
            resolve(str(scenario)),
            output,
            started=started,
            frames=frames,
            workers=workers,
            settings=settings,
            on_progress=progress,
            on_notice=on_notice,
            force=force,
            anyway=anyway,
        )
    return Run(output)


def attack_claimed(
    scenario: Path,
    folder: Path,
    *,
    object_field: Path | None = None,
    started: float,
    frames: Frames | None,
    workers: int | None,
    settings: Sequence[str],
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
        workers: as of :func:`attack_policy`; None for one per core, 1 for a policy or
            an environment behind one server.
        settings: as of :func:`attack_policy`.
        on_progress: called with stage, steps done, steps in all and a remark.
        on_notice: called with a sentence.
        force: as of :func:`attack_policy`.
        anyway: as of :func:`attack_policy`.

    Returns:
        the document that ``metrics.json`` holds.
    """
    described, text = load_scenario(scenario, object_field, settings)
    if frames == "all":
        require("videos of all cases", "av")
    variant.ensure()
    policy = described.build_policy()
    with one_thread():
        job = Job(
            described,
            text,
            policy,
            output=folder,
            on_progress=on_progress,
            on_notice=on_notice,
            started=started,
            frames=frames,
            workers=scenario_workers([described], workers),
        )
        return job.run_claimed(force, anyway)
