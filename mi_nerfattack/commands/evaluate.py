"""``mi-nerfattack evaluate``: the closed-loop error of a policy, its card."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from mi_nerfattack.commands.shared.evaluate_options import (
    Facing,
    PlaceOptions,
    parse_conditions,
    parse_scales,
)
from mi_nerfattack.commands.shared.options import Settings, command_line
from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.commands.shared.terminal import Result, console
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.evaluation.evaluate import EvaluateSettings
    from mi_nerfattack.evaluation.identity import EnvironmentUnder
    from mi_nerfattack.evaluation.work import EvaluateDrives, Evaluation
    from mi_nerfattack.scenario.policy.base import AbstractPolicySection
    from mi_nerfattack.system.workers import AbstractWorkers
    from mi_nerfattack.training.record import TrainingRecord
    from mi_nerfattack.vehicle.route.route import Route

_PERIOD_S = 0.1  # of a server while its map is read


@dataclass(frozen=True)
class Evaluate:
    """Drive a policy in the closed loop, per environment and route, and print its card.

    Each drive starts at random near the route's start: one drive alone, and one drive
    past each number of objects with random textures. The expert drives from the same
    starts. Finished drives are kept: the same command continues after Ctrl-C, and more
    runs or numbers of objects add to them.
    """

    continues: ClassVar[bool] = True

    policy: tyro.conf.Positional[str | None] = None
    """Policy: .safetensors of train, .pt2, .pt, .onnx, FILE.py:NAME, a URL; or a TOML
    file, a scenario or its sections [policy], [camera] and [vehicle]. A scenario is
    driven in its scene unless options name another. The bundled policy by default."""
    settings: Settings = ()
    """Set a key of the TOML file: policy.trust_code=true."""
    environments: tuple[str, ...] = ("surrogate", "mitsuba", "mujoco")
    """Of surrogate, mitsuba, mujoco, mujoco_gl, and carla (needs --server)."""
    routes: tuple[str, ...] = ()
    """Routes by name; all by default, or the route of a scenario."""
    runs: int = 20
    """Drives of each case, environment and route."""
    objects: tuple[int, ...] = (1,)
    """Numbers of objects, a case each; 0: none."""
    scale: tuple[float, ...] = ()
    """Least and most factor to the size, of all or each object."""
    facing: Facing = "shape"
    """Boards face the traffic, none, or all."""
    seed: int = 1
    """Seed of starts, textures and images."""
    horizon: int = 1000
    """Most control periods of a drive."""
    conditions: tuple[str, ...] = ("day",)
    """Times of day and exposures, not for the surrogate: noon, evening,exposure:+1."""
    spp: int = 4
    """Samples per pixel of path-traced images."""
    where: Annotated[
        PlaceOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="place")
    ] = PlaceOptions()
    workers: int | None = None
    """Processes that drive; by default one per core."""
    drives: Path = Path("runs/evaluate")
    """Folder of finished drives."""
    output: Path | None = None
    """File for the card (.json)."""
    page: Path | None = None
    """Folder for the policy's page: NAME.md, .card.json, .png."""
    json: bool = False
    """Print the card as JSON instead of the table."""

    def run(self) -> Result:
        """Drive, summarise, print and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.evaluation.work import run_evaluation
        from mi_nerfattack.io import files
        from mi_nerfattack.report.table import card_table

        if self.output is not None:
            files.check_writable(self.output)
        if self.page is not None:
            files.make_folder(self.page)
        variant.ensure()
        work = self._work()
        workers = self._workers(work.policy)
        record = None if self.page is None else _training_record(work)
        start = time.monotonic()
        with StageBars() as bars:
            bars.say(f"drives are kept in {work.store.folder}")
            if any(self.objects) and not work.place.objects:
                town = "a town its --scene, " * (self.where.server is not None)
                bars.say(f"no drives past objects: {town}a scene its --object FILE")
            evaluation = run_evaluation(work, workers, bars.counter("driving", "step "))
        if self.output is not None:
            files.write_json(self.output, evaluation.card)
        if self.page is not None:
            self._write_page(
                self.page,
                work,
                record,
                evaluation=evaluation,
                wall_s=time.monotonic() - start,
            )
        return Result(
            evaluation.card, lambda: console().print(card_table(evaluation.card))
        )

    def _write_page(
        self,
        folder: Path,
        work: EvaluateDrives,
        record: TrainingRecord | None,
        evaluation: Evaluation,
        wall_s: float,
    ) -> None:
        from mi_nerfattack.report.pages.policy import write_policy_page

        description = {
            **work.describe(),
            "command": command_line("evaluate", self),
            "wall_s": wall_s,
            "seconds_a_drive": {
                f"{environment}, {case}": seconds
                for (environment, case), seconds in evaluation.seconds.items()
            },
        }
        path = write_policy_page(
            folder, description, record, card=evaluation.card, drives=evaluation.drives
        )
        print(f"{path}: written", file=sys.stderr)

    def _work(self) -> EvaluateDrives:
        """Check everything that can be checked before the first drive."""
        from mi_nerfattack.drives.store import Store
        from mi_nerfattack.evaluation.work import EvaluateDrives, check_policy
        from mi_nerfattack.scenario.policy.base import misfit
        from mi_nerfattack.scenario.world import at_own_speed

        file = PolicyFile.read(self.policy, self.settings)
        section, under = file.section, self._environments()
        place = file.place(self.where)
        file.check_wheels("--environments", self.environments)
        own = file.keeps_place(self.where)
        routes, settings = self._routes(place.routes, file), self._settings(place, own)
        if file.vehicle is not None:
            motion = file.vehicle.motion()
            routes = tuple(at_own_speed(route, motion) for route in routes)
            settings = replace(settings, car_width_m=place.car.width)
        vehicle = file.vehicle
        taken = place.car.control_unit if vehicle is None else vehicle.unit
        if reason := misfit(section.unit(), taken, section.source):
            raise InputError(f"policy: the car of the place {reason}")
        check_policy(section.build(place.rig.views), place, routes)
        store = Store(self.drives)
        return EvaluateDrives(
            store=store,
            policy=section,
            place=place,
            environments=under,
            routes=routes,
            settings=settings,
            vehicle=vehicle,
        )

    def _settings(self, place: Place, is_own: bool) -> EvaluateSettings:
        """Say how to drive at a place: the scenario's own, or one of the options."""
        from mi_nerfattack.training.presets import EVALUATIONS, evaluation_for

        settings = EVALUATIONS[self.where.bundled]
        if is_own:
            settings = evaluation_for(place.car.width)
        scales = parse_scales(self.scale, len(place.objects))
        return replace(
            settings,
            runs=self.runs,
            roadside=replace(
                settings.roadside,
                scales=scales or settings.roadside.scales,
                facing=self.facing,
            ),
            objects=self.objects,
            seed=self.seed,
            horizon=self.horizon,
        )

    def _routes(self, path: Path, file: PolicyFile) -> tuple[Route, ...]:
        from mi_nerfattack.vehicle.route.route import load_routes

        names = self.routes
        if names:
            _check_different("--routes", names)
        elif file.keeps_place(self.where) and self.where.routes_file is None:
            assert file.scenario is not None
            names = (file.scenario.scene.route,)
        if path.suffix.lower() == ".xml":
            return self._leaderboard(path)
        return tuple(load_routes(path, names))

    def _leaderboard(self, path: Path) -> tuple[Route, ...]:
        """Follow the lanes of the server's town."""
        from mi_nerfattack.deploy.carla.route import town_routes
        from mi_nerfattack.deploy.carla.session import (
            CarlaServer,
            CarlaSession,
            load_client,
        )

        if self.where.server is None:
            raise InputError(
                f"--routes-file: {path}; routes of CARLA's leaderboard need the town: "
                "--server, or convert the file with 'mi-nerfattack export routes'"
            )
        api = load_client()
        session = CarlaSession(CarlaServer.parse(self.where.server), _PERIOD_S, api)
        try:
            return tuple(town_routes(path, session.town_map, api, names=self.routes))
        finally:
            session.close()

    def _environments(self) -> tuple[EnvironmentUnder, ...]:
        from mi_nerfattack.deploy.registry import ENVIRONMENTS, offered_environment

        _check_different("--environments", self.environments)
        known = [name for name in ENVIRONMENTS if name != "replay"]
        for name in self.environments:
            if name == "replay":
                raise InputError(
                    f"--environments: {name!r}; one of {', '.join(known)} (a recording "
                    "does not answer to a policy)"
                )
            if name not in known:
                offered_environment(name, "--environments: ", known)
        self.where.check(self.environments)
        return parse_conditions(self.environments, self.conditions, self.spp)

    def _workers(self, policy: AbstractPolicySection) -> AbstractWorkers:
        from mi_nerfattack.system.workers import chosen_workers

        alone = "carla" in self.environments or policy.is_remote
        return chosen_workers(self.workers, alone)


def evaluate_policy(
    policy: str | Path,
    folder: str | Path,
    *,
    environments: tuple[str, ...] = Evaluate.environments,
    routes: tuple[str, ...] = (),
    runs: int = Evaluate.runs,
    objects: tuple[int, ...] = Evaluate.objects,
    seed: int = Evaluate.seed,
    horizon: int = Evaluate.horizon,
    spp: int = Evaluate.spp,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Evaluation:
    """Drive a policy in the closed loop: ``mi-nerfattack evaluate``.

    Args:
        policy: a scenario (TOML), which is driven in its own scene, or another policy
            that the command takes.
        folder: of the drives; finished drives are not repeated.
        environments: names of environments.
        routes: by name; by default all routes, or the route of the scenario.
        runs: drives of each environment, route and case.
        objects: numbers of objects with random textures at the roadside, one case per
            number.
        seed: of starts, places, textures and images.
        horizon: most control periods of a drive.
        spp: samples per pixel of path-traced images.
        workers: processes that drive. A script that takes more than 1 needs
            ``if __name__ == "__main__":``, as with `multiprocessing`.
        progress: called with control periods done and in all, for example
            `mi_nerfattack.progress(stage="driving")`.

    Raises:
        InputError: an argument or a file does not fit.
    """
    from mi_nerfattack import variant
    from mi_nerfattack.evaluation.work import run_evaluation

    variant.ensure()
    command = Evaluate(
        policy=str(policy),
        environments=environments,
        routes=routes,
        runs=runs,
        objects=objects,
        seed=seed,
        horizon=horizon,
        spp=spp,
        workers=workers,
        drives=Path(folder),
    )
    work = command._work()
    return run_evaluation(work, command._workers(work.policy), progress)


def _check_different(option: str, names: tuple[str, ...]) -> None:
    if not names or len(set(names)) < len(names):
        raise InputError(f"{option}: {' '.join(names)!r}; at least one, each once")


def _training_record(work: EvaluateDrives) -> TrainingRecord | None:
    """Read what training wrote beside the policy; None where it wrote nothing."""
    from mi_nerfattack.scenario.policy.kinds import PilotNetSection, ProgramSection
    from mi_nerfattack.training.record import read_record

    if not isinstance(work.policy, PilotNetSection | ProgramSection):
        return None
    path = work.policy.file.file.with_suffix(".json")
    return read_record(path) if path.is_file() else None
