"""The drives of a run: what objects show in each case and environment; who drives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mi_nerfattack.backend.determinism import deterministic
from mi_nerfattack.deploy.environment import drive
from mi_nerfattack.drives.run import (
    AbstractDriver,
    AbstractDrives,
    Groups,
    run_drives,
)
from mi_nerfattack.drives.spec import DriveSpec, identify
from mi_nerfattack.drives.store import Store
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.baseline import RandomAppearances
from mi_nerfattack.io.resumable import flatten
from mi_nerfattack.rollout.drive import NO_OBJECT, OWN, RANDOM, Drive
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.deployment import SURROGATE, labelled
from mi_nerfattack.scenario.named_file import section_content
from mi_nerfattack.scenario.scenario import SURROGATE_KEYS, Scenario, is_within
from mi_nerfattack.scenario.world import Appearance, World, build_world
from mi_nerfattack.system.workers import AbstractWorkers, chosen_workers, tally

#: Called with stage, steps done, steps in all, and a remark.
OnProgress = Callable[[str, int, int, str], None]

#: Parts of a scenario that say how it is searched, not how it is driven.
SEARCH_KEYS = (
    "name",
    "attack",
    "baseline",
    "objective",
    "deployment",
    "scene.bricks",
    "drive.runs",
)


def decisive(
    scenario: Scenario, identity: Mapping[str, str], in_surrogate: bool
) -> dict[str, str]:
    """Return what of a scenario decides about drives in an environment.

    Not what objects show, where a drive starts, its seed, and ``[deployment]``.

    Args:
        scenario: of the drives.
        identity: its :meth:`Scenario.identity`.
        in_surrogate: whether they are in the surrogate, not in a deployment.
    """
    inert, named = [*SEARCH_KEYS, "seed"], {}
    if in_surrogate:
        inert.append("scene.deployment")
        own = scenario.attack
        # a Mitsuba scene says itself what is random
        random = own.jitter or scenario.scene.surrogate is not None
        seed = f"{scenario.seed}" if random else "none"
        named = {"random": seed, "attached": f"{own.attached}"}
    else:
        inert += [f"scene.{name}" for name in SURROGATE_KEYS]
    return named | {k: v for k, v in identity.items() if not is_within(k, inert)}


def step_counter(
    on_progress: OnProgress, stage: str, total: int, done: int = 0
) -> OnStep:
    """Return a function that reports the progress of sweeps through a drive.

    It takes the index of a control period and counts one step.

    Args:
        on_progress: called with stage, steps done, all steps and an empty remark.
        stage: name of the stage, for `on_progress`.
        total: steps of all sweeps.
        done: steps that were done before.
    """
    count = tally(lambda now, most: on_progress(stage, now, most, ""), done, total)
    return lambda step: count(1)


@dataclass(frozen=True, eq=False)
class Shown:
    """What a drive shows, and from where it starts.

    Attributes:
        start: (3,) pose.
        look: appearance of all objects, or a value that the driver turns into an
            appearance; None without objects.
        digest: of the appearance.
    """

    start: np.ndarray
    look: Any
    digest: str


class CaseDriver(AbstractDriver):
    """Drives in a world, whose objects show what each drive asks for.

    Args:
        world: to drive in.
        looks: turns a `look` that is no appearance into one.
    """

    def __init__(self, world: World, looks: Callable[[Any], Appearance]) -> None:
        super().__init__()
        self._world, self._looks = world, looks

    def drive(self, spec: DriveSpec, on_step: OnStep) -> Drive:
        """Drive once."""
        world, shown, label = self._world, spec.context, spec.environment
        look, empty = shown.look, shown.look is None
        if not empty:
            world.show(look if isinstance(look, Appearance) else self._looks(look))
        key = label, empty, shown.digest if world.builds_in(label) else None
        with deterministic(world.scenario.attack.deterministic):
            return drive(
                self.environment.get(key, lambda: world.open(label, empty)),
                world.policy,
                world.route,
                pose=shown.start,
                seed=spec.seed,
                steps=spec.steps,
                on_step=on_step,
                case=spec.case,
                run=spec.run,
                label=label,
            )


@dataclass(frozen=True, eq=False)
class CaseDrives(AbstractDrives):
    """Some drives of a run.

    Args:
        store: of those that are finished.
        specs: of the drives.
        scenario: of the run.
        own: how the objects look by themselves.
        world: of this process; another process builds its own.
    """

    specs: Sequence[DriveSpec]
    scenario: Scenario
    own: Appearance
    world: World | None

    @cached_property
    def groups(self) -> Sequence[Sequence[DriveSpec]]:
        """Each drive by itself."""
        return [[spec] for spec in self.specs]

    def open(self) -> CaseDriver:
        """Build the world, unless it is there."""
        world = self.world
        if world is None:
            world = build_world(self.scenario, self.scenario.build_policy())
        return CaseDriver(world, RandomAppearances.of(world, self.own))

    def __getstate__(self) -> dict[str, Any]:
        """Leave the world behind, which no process can send."""
        return {**self.__dict__, "world": None}


@dataclass
class Cases:
    """Drives through a world, by environment and case.

    Attributes:
        world: fields, environments, policy.
        store: of finished drives.
        identity: of the scenario, see :meth:`Scenario.identity`.
        on_progress: called after every control period with stage, steps done, all
            steps and a remark.
        on_drives: called whenever drives were done.
        own: the original appearance of the objects.
        looks: by case, what all its drives show; None for no objects.
        renders: frames that the world's sensors did not render.
    """

    world: World
    store: Store
    identity: Mapping[str, str]
    on_progress: OnProgress
    on_drives: Callable[[], None]
    own: Appearance = field(init=False)
    looks: dict[str, Appearance | None] = field(init=False)
    renders: int = 0
    _driver: CaseDriver | None = None
    _identities: dict[str, dict[str, str]] = field(default_factory=dict)
    _random: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.own = self.world.appearance()
        self.looks = {NO_OBJECT: None, OWN: self.own}

    def of_case(self, label: str, case: str) -> list[DriveSpec]:
        """Describe the drives of a case from all initial states.

        In an open loop, where starts have no effect, there is one.
        """
        count = 1 if self.world.is_open_loop(label) else len(self.world.initial)
        return [self._spec(label, case, run, self.looks[case]) for run in range(count)]

    def of_random(self, label: str, count: int) -> list[DriveSpec]:
        """Describe drives with random textures, each from one of the initial states."""
        return [self._spec(label, RANDOM, run, run) for run in range(count)]

    def one(self, label: str, case: str, run: int) -> Drive:
        """Return one of the drives of a case, which is then kept."""
        spec = self._spec(label, case, run, self.looks[case])
        if (stored := self.store.read(spec)) is not None:
            return stored.drive
        if self._driver is None:
            looks = RandomAppearances.of(self.world, self.own)
            self._driver = CaseDriver(self.world, looks)
        on_step = step_counter(self.on_progress, f"{label}: {case}", spec.steps)
        count = self.counter()
        driven = self._work([spec]).drive(self._driver, spec, on_step)
        count(len(driven.states))
        return driven

    def drive(
        self, specs: Sequence[DriveSpec], workers: AbstractWorkers
    ) -> list[Drive]:
        """Return drives, after those that are missing were done.

        Args:
            specs: of the drives.
            workers: who does them.
        """
        self.close()
        is_first, count = True, self.counter()

        def on_groups(groups: Groups) -> None:
            nonlocal is_first
            if not is_first:  # the first are those that were there
                for [item] in groups.values():
                    count(len(item.drive.states))
            is_first = False

        def progress(done: int, total: int) -> None:
            self.on_progress("drives", done, total, "")

        finished_groups = run_drives(
            self._work(specs), workers, progress, on_groups=on_groups
        )
        return [item.drive for [item] in finished_groups]

    def counter(self) -> Callable[[int], None]:
        """Return what counts the frames of work that begins now.

        The world's sensors count those that they render, in this process.
        """
        renders_before = self.world.renders

        def count(frames: int) -> None:
            nonlocal renders_before
            self.renders += frames - (self.world.renders - renders_before)
            renders_before = self.world.renders
            self.on_drives()

        return count

    def close(self) -> None:
        """Close the environment that is open."""
        if self._driver is not None:
            self._driver.close()
        self._driver = None

    def _work(self, specs: Sequence[DriveSpec]) -> CaseDrives:
        world = self.world
        return CaseDrives(self.store, specs, world.scenario, self.own, world)

    def _spec(
        self, label: str, case: str, run: int, look: Appearance | int | None
    ) -> DriveSpec:
        world = self.world
        start, seed = world.initial[run % len(world.initial)], world.scenario.seed + run
        digest = "none" if look is None else self._digest(look)
        decided = {"look": digest, "start": start.tolist(), "seed": seed}
        return DriveSpec(
            environment=label,
            route=world.route.name,
            case=case,
            run=run,
            seed=seed,
            steps=world.horizon,
            identity=self._shared(label) | flatten("drive", decided),
            context=Shown(start, look, digest),
        )

    def _digest(self, look: Appearance | int) -> str:
        if not isinstance(look, int):
            return look.digest
        if look not in self._random:  # a look may take 100 MB
            self._random[look] = RandomAppearances.of(self.world, self.own)(look).digest
        return self._random[look]

    def _shared(self, label: str) -> dict[str, str]:
        """Return what all drives in an environment have in common."""
        if label not in self._identities:
            self._identities[label] = shared_identity(self.world, self.identity, label)
        return self._identities[label]


def shared_identity(
    world: World, identity: Mapping[str, str], label: str
) -> dict[str, str]:
    """Return what decides about all drives in an environment.

    Not what objects show, where a drive starts, and its seed.

    Args:
        world: of the drives.
        identity: of its scenario, see :meth:`Scenario.identity`.
        label: of the environment.
    """
    name, section, in_surrogate = None, {}, label == SURROGATE
    if not in_surrogate:
        name = world.deployments[label].environment
        section = section_content(dict(labelled(world.scenario.deployment))[label])
    shared = decisive(world.scenario, identity, in_surrogate)
    return identify(name, shared | flatten("deployment", section))


def drives_in_carla(
    scenarios: Sequence[Scenario], environment: str | None = None
) -> bool:
    """Whether a deployment is in CARLA, whose server has one client.

    Args:
        scenarios: to be driven.
        environment: label of the only one that they drive in; None: all.
    """
    return any(
        section.has_one_client and environment in (None, label)
        for scenario in scenarios
        for label, section in labelled(scenario.deployment)
    )


def need_one_process(
    scenarios: Sequence[Scenario], count: int | None, environment: str | None = None
) -> bool:
    """Whether one process drives scenarios, because of a server.

    Args:
        scenarios: to be driven.
        count: of processes, as the user chose it; None if the user did not.
        environment: as of `drives_in_carla`.

    Raises:
        InputError: several processes for a deployment in CARLA.
    """
    if in_carla := drives_in_carla(scenarios, environment):
        if count not in (None, 1):
            raise InputError(
                f"workers: {count} for a deployment in CARLA, whose server one process "
                "steps; give 1"
            )
    behind_url = any(scenario.policy.is_remote for scenario in scenarios)
    return in_carla or (count is None and behind_url)


def scenario_workers(
    scenarios: Sequence[Scenario], count: int | None, environment: str | None = None
) -> AbstractWorkers:
    """Return who drives scenarios; without a server, by default a process per core.

    Args:
        scenarios: to be driven.
        count: as of `need_one_process`.
        environment: as of `drives_in_carla`.

    Raises:
        InputError: see `need_one_process`.
    """
    return chosen_workers(count, need_one_process(scenarios, count, environment))
