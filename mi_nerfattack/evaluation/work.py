"""An evaluation by several processes; finished drives are files and never repeated."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.place import Place
from mi_nerfattack.deploy.registry import environment_versions, make_environment
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.deploy.sites import CARLA, PlaceSite
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import (
    EXPERT,
    EvaluateSettings,
    ExpertPolicy,
    check_places,
    evaluate_run,
    make_card,
)
from mi_nerfattack.evaluation.identity import (
    EnvironmentUnder,
    section_content,
    short_digest,
)
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.rollout.drive import NO_OBJECT, Drive, departure_limits
from mi_nerfattack.scenario.policy import AbstractPolicySection
from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
from mi_nerfattack.system.workers import (
    AbstractWork,
    AbstractWorkers,
    InThisProcess,
    OnUnits,
)
from mi_nerfattack.vehicle.expert import expert_for
from mi_nerfattack.vehicle.route.route import Route

_REMEDY = "choose another folder for the drives, or remove this one"
#: The expert sees no image: the smallest are rendered for it, of square pixels.
_EXPERT_CAMERA = from_fov(8, 3, 90.0)


class DriveRecord(Record):
    """What a kept drive does not say: its seed, and the seconds that it took."""

    seed: int
    wall_s: float


@dataclass(frozen=True, eq=False)
class Job:
    """One drive: a case of the card, or "expert"."""

    environment: EnvironmentUnder
    route: Route
    case: str
    run: int


@dataclass(frozen=True, eq=False)
class EvaluateWork(AbstractWork):
    """All drives of an evaluation.

    Args:
        policy: that drives, as a scenario describes it.
        place: where.
        environments: with different labels.
        routes: with different names.
        settings: see there.
        folder: of the drives.
        identities: of the drives of each environment and route, see `identify`.
        vehicle: that drives in the place's surrogate and path-traced scene, where it is
            no kinematic model of the place's car.
    """

    policy: AbstractPolicySection
    place: Place
    environments: tuple[EnvironmentUnder, ...]
    routes: tuple[Route, ...]
    settings: EvaluateSettings
    folder: Path
    identities: Mapping[tuple[str, str], Mapping[str, str]]
    vehicle: AbstractVehicleSection | None = None

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases; without objects there is one."""
        return self.settings.cases if self.place.objects else (NO_OBJECT,)

    @property
    def jobs(self) -> list[Job]:
        """Every drive; those of one environment and of one sort together."""
        return [
            Job(environment, route, case, run)
            for environment in self.environments
            for sort in ((EXPERT,), self.cases)
            for route in self.routes
            for case in sort
            for run in range(self.settings.runs)
        ]

    def build_place(self) -> Place:
        """Return the place with the vehicle's motion, which no process can send."""
        if self.vehicle is None:
            return self.place
        return replace(self.place, motion=self.vehicle.motion())

    def open(self) -> Opened:
        """Load policy, objects and their surroundings."""
        return Opened(self)

    def do(self, opened: Opened, index: int, report: OnUnits) -> None:
        """Drive once and write the drive; a unit is a control period."""
        job, start = self.jobs[index], time.monotonic()
        result = opened.drive(job, lambda step: report(1))
        seconds = time.monotonic() - start
        unit = self._unit(job)
        files.make_folder(unit.path.parent)
        unit.write(result.arrays(), DriveRecord(seed=result.seed, wall_s=seconds))

    def close(self, opened: Opened) -> None:
        """Close the environment."""
        opened.close()

    def path(self, job: Job) -> Path:
        """Return the file of a drive."""
        label, route = job.environment.label, job.route.name
        folder = self.folder / f"{label}-{short_digest(self.identities[label, route])}"
        parts = (quote(route, safe=""), job.case, f"run_{job.run:04d}.safetensors")
        return folder.joinpath(*parts)

    def steps(self, job: Job) -> int:
        """Return the number of control periods of a drive."""
        return self.settings.steps(job.route, self.place.period)

    def read(self, job: Job) -> tuple[Drive, float] | None:
        """Read a drive and its seconds; None where it was not finished.

        Raises:
            InputError: the file is damaged, or of another evaluation.
        """
        kept = self._unit(job).read()
        if kept is None:
            return None
        found = Drive(
            environment=job.environment.name,
            route=job.route.name,
            case=NO_OBJECT if job.case == EXPERT else job.case,
            run=job.run,
            seed=kept.record.seed,
            **kept.tensors,
        )
        return found, kept.record.wall_s

    def describe(self) -> dict[str, Any]:
        """Return policy, place, routes, environments and settings, as JSON."""
        place, names = self.place, {under.name for under in self.environments}
        paths = [place.routes, *place.objects]
        paths = paths if names == {CARLA} else [place.scene, *paths]
        where = [f"{path.resolve().parent.name}/{path.name}" for path in paths]
        if CARLA in names:  # not the machine that it runs on
            where.append(f"CARLA's {place.server.partition('/')[2] or 'loaded town'}")
        return {
            "policy": _relative(self.policy.source),
            "policy_section": section_content(self.policy),
            "vehicle_section": self.vehicle and section_content(self.vehicle),
            "place": where,
            "routes": [route.name for route in self.routes],
            "environments_under": {
                under.label: {"sky": c.sky, "exposure_ev": c.exposure_ev, "spp": c.spp}
                for under in self.environments
                for c in (under.conditions,)
            },
            "settings": asdict(self.settings),
            "versions": {
                **versions(),
                **{
                    package: version
                    for under in self.environments
                    for package, version in environment_versions(under.name).items()
                },
            },
        }

    def _unit(self, job: Job) -> Unit[DriveRecord]:
        shared = self.identities[job.environment.label, job.route.name]
        identity = {**shared, "case": job.case, "run": f"{job.run}"}
        return Unit(self.path(job), identity, DriveRecord, _REMEDY)


class Opened:
    """What a process needs for its drives; one environment at a time."""

    def __init__(self, work: EvaluateWork) -> None:
        self._work = work
        self._policy, self._place = work.policy.build(), work.build_place()
        self._objects, self._surroundings = load_objects(work)
        self._key: tuple[str, bool] | None = None
        self._environment: AbstractEnvironment | None = None

    def drive(self, job: Job, on_step: Callable[[int], None]) -> Drive:
        """Drive once."""
        environment = self._open(job)
        driver, case = self._policy, job.case
        if case == EXPERT:
            driver, case = self._expert(environment, job.route), NO_OBJECT
        return evaluate_run(
            environment,
            driver,
            job.route,
            case,
            job.run,
            self._objects,
            self._surroundings,
            self._work.settings,
            on_step,
        )

    def close(self) -> None:
        """Close the environment, where there is one."""
        if self._environment is not None:
            self._environment.close()
        self._key = self._environment = None

    def _open(self, job: Job) -> AbstractEnvironment:
        blind, under = job.case == EXPERT, job.environment
        if self._environment is None or self._key != (under.label, blind):
            self.close()
            place, conditions = self._place, under.conditions
            if blind:
                place = replace(place, camera=_EXPERT_CAMERA)
                conditions = replace(conditions, spp=1)
            self._environment = make_environment(under.name, place, conditions)
            self._key = under.label, blind
        return self._environment

    def _expert(self, environment: AbstractEnvironment, route: Route) -> ExpertPolicy:
        expert = expert_for(
            environment.control_unit,
            route,
            environment.period,
            environment.max_control,
            self._work.place.car.wheelbase,
        )
        return ExpertPolicy(environment, expert)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A finished evaluation.

    Args:
        card: {ENVIRONMENT: {ROUTE: {CASE: figures}}}; the figures of the case
            "no_object" have those of the expert as `expert`.
        drives: by environment, route and case ("expert" among them).
        seconds: of a drive on one worker, mean, by environment and case.
    """

    card: dict[str, Any]
    drives: Mapping[tuple[str, str, str], Sequence[Drive]]
    seconds: Mapping[tuple[str, str], float]

    def __repr__(self) -> str:
        environments, routes, _ = map(dict.fromkeys, zip(*self.drives, strict=True))
        count = sum(len(drives) for drives in self.drives.values())
        where = f"{', '.join(environments)}; routes: {', '.join(routes)}"
        return f"Evaluation({count} drives: {where})"


def run_evaluation(
    work: EvaluateWork,
    workers: AbstractWorkers,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Evaluation:
    """Do the drives that are not there yet, and summarise all.

    Args:
        work: all drives.
        workers: who does them.
        progress: called with control periods done and wanted.

    Raises:
        InputError: before the first drive, a lane narrower than the car, objects
            that find no place, an environment that cannot be made, several processes
            for CARLA, drives of another evaluation in the folder, or one that cannot
            be made; later, a policy that does not take the images.
    """
    limits = departure_limits(work.routes, work.settings.car_width_m)
    _check_workers(work, workers)
    jobs = work.jobs
    steps = [work.steps(job) for job in jobs]
    found = [work.read(job) for job in jobs]
    left = [index for index, item in enumerate(found) if item is None]
    done, total = sum(steps) - sum(steps[index] for index in left), sum(steps)
    # what cannot be made is told now, not after the hours of those before it
    if any(jobs[index].case not in (EXPERT, NO_OBJECT) for index in left):
        objects, surroundings = load_objects(work)
        arguments = (work.routes, objects, surroundings, work.settings)
        check_places(work.place.period, *arguments)
    for under in dict.fromkeys(jobs[index].environment for index in left):
        make_environment(under.name, work.build_place(), under.conditions).close()
    files.make_folder(work.folder)

    def count(units: int) -> None:
        nonlocal done
        done += units
        progress(done, total)

    workers.run(work, left, count)
    drives: dict[tuple[str, str, str], list[Drive]] = {}
    seconds: dict[tuple[str, str], list[float]] = {}
    for job in jobs:
        item = work.read(job)
        if item is None:
            raise InputError(f"{work.path(job)}: does not exist; it was removed")
        label = job.environment.label
        drives.setdefault((label, job.route.name, job.case), []).append(item[0])
        seconds.setdefault((label, job.case), []).append(item[1])
    means = {key: sum(values) / len(values) for key, values in seconds.items()}
    return Evaluation(make_card(drives, limits), drives, means)


def load_objects(
    work: EvaluateWork,
) -> tuple[list[GridField], Surroundings | None]:
    """Load the objects of an evaluation and their surroundings, where it has any."""
    if work.cases == (NO_OBJECT,):
        return [], None
    site = PlaceSite(work.environments[0].name, work.place)
    return site.load_objects(work.settings.most), site.load_surroundings()


def _check_workers(work: EvaluateWork, workers: AbstractWorkers) -> None:
    named = CARLA in (under.name for under in work.environments)
    if named and not isinstance(workers, InThisProcess):
        raise InputError(
            "workers: several processes for the environment 'carla', which would tick "
            "one server and could end without giving it back; 1 drives in this process"
        )


def check_policy(policy: AbstractPolicy, place: Place, routes: Sequence[Route]) -> None:
    """Show a policy a black image for every goal.

    Raises:
        InputError: the camera's image or a goal does not fit, or PilotNet's unit is
            not the car's.
    """
    if isinstance(policy, TorchPolicy) and isinstance(policy.module, PilotNet):
        given, taken = policy.module.unit, place.car.control_unit
        if given != taken and policy.control_scale == 1:
            raise InputError(
                f"policy: gives {given}, the car of the place takes {taken}; evaluate "
                "a policy of this car, or convert with --control-scale"
            )
    shape = (1, place.camera.height, place.camera.width, 3)
    image = mi.TensorXf(np.zeros(shape, np.float32))
    for route in routes:
        policy.step(image, route.goal, policy.initial_memory(1))


def _relative(name: str) -> str:
    """Drop the folder of an absolute path: it tells about the machine alone."""
    return Path(name).name if Path(name).is_absolute() else name
