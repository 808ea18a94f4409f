"""The drives of a run, each done once, however often the run is interrupted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from mi_nerfattack.deploy.driving import drive
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.kept_drives import KeptDrives, SharedDrives
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, misfits_told
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, RANDOM, Drive
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World

#: Called with stage, steps done, steps in all, and a remark.
OnProgress = Callable[[str, int, int, str], None]
#: Returns the objective of what the objects look like.
Judge = Callable[[OnStep], float]


def step_counter(
    on_progress: OnProgress, stage: str, total: int, done: int = 0
) -> OnStep:
    """Return what reports the progress of sweeps through a drive, step by step.

    Args:
        on_progress: told.
        stage: what it is told.
        total: steps of all sweeps.
        done: of them, before.
    """

    def on_step(step: int) -> None:
        nonlocal done
        del step
        done += 1
        on_progress(stage, done, total, "")

    return on_step


@dataclass
class Stages:
    """Drives through a world, keeping each on disk as it ends.

    One environment is open at a time.

    Attributes:
        world: fields, environments, policy.
        kept: drives that are finished.
        on_progress: told about every time step.
        effort: tells what the run has cost so far.
        shared: drives that other runs have in common with this one, if any; those past
            what its attack found are its own.
        looks: by case, what all its drives show; None for no objects.
        drives: all drives that were asked for so far.
        renders: frames that the world's surrogate did not render.
    """

    world: World
    kept: KeptDrives
    on_progress: OnProgress
    effort: Callable[[], Effort]
    shared: SharedDrives | None = None
    looks: dict[str, Appearance | None] = field(
        default_factory=lambda: {NO_OBJECT: None}
    )
    drives: list[Drive] = field(default_factory=list)
    renders: int = 0
    _opened: tuple[object, AbstractEnvironment] | None = None

    def drive_all(self, label: str, case: str) -> None:
        """Drive from all initial states with the look of a case; once in an open loop.

        Args:
            label: of the environment.
            case: of the drives.
        """
        count = 1 if self.world.is_open_loop(label) else len(self.world.initial)
        if look := self.looks[case]:
            self.world.show(look)
        for run in range(count):
            if not self._take(label, case, run, count):
                found = self._drive(label, case, run, count, case)
                self.drives.append(found)

    def one(self, label: str, case: str, run: int) -> Drive:
        """Return one of the drives of :meth:`drive_all`, which then finds it kept."""
        if found := self.kept.take(label, case, run):
            return found
        if look := self.looks[case]:
            self.world.show(look)
        return self._drive(label, case, run, len(self.world.initial), case)

    def drive_random(
        self,
        label: str,
        count: int,
        look: Callable[[int], Appearance],
        judge: Judge | None = None,
    ) -> list[float | None]:
        """Drive with random looks, each from one of the initial states.

        Args:
            label: of the environment.
            count: of looks.
            look: gives each by its number.
            judge: gives the objective of each, beside the drive.

        Returns:
            the objectives; of a drive that was kept, what was kept.
        """
        sweeps, horizon = 1 if judge is None else 2, self.world.horizon
        for run in range(count):
            if self._take(label, RANDOM, run, count, sweeps):
                continue
            self.world.show(look(run))
            done, objective = run * sweeps * horizon, None
            if judge is not None:
                total = count * sweeps * horizon
                objective = judge(
                    lambda step, done=done, total=total: self.on_progress(
                        f"{label}: {RANDOM}", done + step + 1, total, "judged"
                    )
                )
            found = self._drive(label, RANDOM, run, count, run, sweeps, objective)
            self.drives.append(found)
        return [self.kept.objective(label, RANDOM, run) for run in range(count)]

    def close(self) -> None:
        """Close the environment that is open."""
        if self._opened is not None:
            self._opened[1].close()
        self._opened = None

    def _take(
        self, label: str, case: str, run: int, count: int, sweeps: int = 1
    ) -> bool:
        """Take up a drive that is finished; False if it is not."""
        found = self.kept.take(label, case, run)
        if found is None:
            return False
        horizon = self.world.horizon * sweeps
        done, total = (run + 1) * horizon, count * horizon
        self.on_progress(f"{label}: {case}", done, total, "kept")
        self.drives.append(found)
        return True

    def _drive(
        self,
        label: str,
        case: str,
        run: int,
        count: int,
        look: object,
        sweeps: int = 1,
        objective: float | None = None,
    ) -> Drive:
        """Drive once, and keep the drive; it is the last sweep of a run."""
        horizon, stage = self.world.horizon, f"{label}: {case}"
        before, total = ((run + 1) * sweeps - 1) * horizon, count * sweeps * horizon
        on_step = step_counter(self.on_progress, stage, total, before)
        if self.shared is None or case == ATTACK:
            found = self._driven(label, case, run, look, on_step)
        else:
            found = self._common(self.shared, label, case, run, look, on_step)
        self.kept.add(found, self.effort(), objective)
        return found

    def _common(
        self,
        shared: SharedDrives,
        label: str,
        case: str,
        run: int,
        look: object,
        on_step: OnStep,
    ) -> Drive:
        """Take up a drive that another run has done, or do it for others, too."""
        world = self.world
        shown = None if case == NO_OBJECT else world.appearance()
        unit = shared.unit(world, label, shown, run)
        if (kept := unit.read()) is None:
            found = self._driven(label, case, run, look, on_step)
            files.make_folder(shared.folder)
            unit.write(found.arrays(), Record())
            return found
        about = label, world.route.name, case, run, world.scenario.seed + run
        with misfits_told(unit.path):
            return Drive(*about, **kept.tensors)

    def _driven(
        self, label: str, case: str, run: int, look: object, on_step: OnStep
    ) -> Drive:
        world, empty = self.world, case == NO_OBJECT
        found = drive(
            self._environment(label, look, empty),
            world.policy,
            world.route,
            world.initial[run % len(world.initial)],
            world.scenario.seed + run,
            world.horizon,
            on_step,
            case,
            run,
            label,
        )
        counted = label == SURROGATE and not empty  # by the surrogate itself
        self.renders += 0 if counted else len(found.states)
        return found

    def _environment(
        self, label: str, look: object, empty: bool
    ) -> AbstractEnvironment:
        """Open an environment, unless it is; another look may need another one."""
        key = label, look if empty or self.world.builds_in(label) else None
        if self._opened is None or self._opened[0] != key:
            self.close()
            self._opened = key, self.world.open(label, empty)
        return self._opened[1]
