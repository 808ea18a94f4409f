"""An evaluation by several processes; finished drives are files and never repeated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.car import acceleration_of
from mi_nerfattack.deploy.environment import AbstractEnvironment, trial_numbers
from mi_nerfattack.deploy.place import Place
from mi_nerfattack.deploy.registry import environment_versions, make_environment
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.deploy.sites import CARLA, PlaceSite
from mi_nerfattack.drives.run import AbstractDriver, AbstractDrives, OnSteps, run_drives
from mi_nerfattack.drives.spec import DriveSpec
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import (
    EvaluateSettings,
    ExpertPolicy,
    check_places,
    drawn_start,
    evaluate_run,
    make_card,
)
from mi_nerfattack.evaluation.identity import EnvironmentUnder, identify
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.io import files
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.rollout.drive import EXPERT, NO_OBJECT, Drive, departure_limits
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.named_file import section_content
from mi_nerfattack.scenario.policy.base import AbstractPolicySection
from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
from mi_nerfattack.system.workers import AbstractWorkers, InThisProcess
from mi_nerfattack.vehicle.dynamics import control_size, require_controls
from mi_nerfattack.vehicle.expert import expert_for
from mi_nerfattack.vehicle.route.route import Route

#: The expert sees no image: the smallest are rendered for it, of square pixels.
_EXPERT_CAMERA = from_fov(8, 3, 90.0)


class _Location(NamedTuple):
    """Where a drive takes place."""

    under: EnvironmentUnder
    route: Route


@dataclass(frozen=True, eq=False)
class EvaluateDrives(AbstractDrives):
    """All drives of an evaluation.

    Args:
        store: of those that are finished.
        policy: that drives, as a scenario describes it.
        place: where.
        environments: with different labels.
        routes: with different names.
        settings: see there.
        vehicle: that drives in the place's surrogate and path-traced scene, where it is
            no kinematic model of the place's car.
    """

    policy: AbstractPolicySection
    place: Place
    environments: tuple[EnvironmentUnder, ...]
    routes: tuple[Route, ...]
    settings: EvaluateSettings
    vehicle: AbstractVehicleSection | None = None

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases; without objects there is one."""
        return self.settings.cases if self.place.objects else (NO_OBJECT,)

    @property
    def has_expert(self) -> bool:
        """Whether an expert drives, too; none knows some of the user's vehicles."""
        return self.vehicle is None or self.vehicle.has_expert

    @cached_property
    def groups(self) -> Sequence[Sequence[DriveSpec]]:
        """Every drive; those of one environment and of one sort together."""
        identities = identify(
            self.policy,
            self.place,
            self.environments,
            routes=self.routes,
            settings=self.settings,
            vehicle=self.vehicle,
        )
        return [
            [self._spec(under, route, case, run, identities[under.label, route.name])]
            for under in self.environments
            for sort in ((EXPERT,) if self.has_expert else (), self.cases)
            for route in self.routes
            for case in sort
            for run in range(self.settings.runs)
        ]

    def _spec(
        self,
        under: EnvironmentUnder,
        route: Route,
        case: str,
        run: int,
        shared: Mapping[str, str],
    ) -> DriveSpec:
        return DriveSpec(
            environment=under.label,
            route=route.name,
            case=case,
            run=run,
            seed=drawn_start(self.settings, route, run)[1],
            steps=self.settings.steps(route, self.place.period),
            identity={**shared, "case": case, "run": f"{run}"},
            context=_Location(under, route),
        )

    def build_place(self) -> Place:
        """Return the place with the vehicle's motion, which no process can send."""
        if self.vehicle is None:
            return self.place
        return replace(self.place, motion=self.vehicle.motion())

    def first(self, objects: Sequence[GridField], count: int) -> Sequence[GridField]:
        """Return the objects among which a drive past `count` of them chooses."""
        return objects[: max(len(self.place.objects), count)]

    def open(self) -> EvaluateDriver:
        """Load policy, objects and their surroundings."""
        return EvaluateDriver(self)

    def check(self, missing: Sequence[DriveSpec]) -> None:
        """Place all objects and make each environment once.

        Raises:
            InputError: objects find no place, or an environment cannot be made.
        """
        if any(spec.case not in (EXPERT, NO_OBJECT) for spec in missing):
            objects, around = load_objects(self)
            for count in self.settings.objects:
                some = self.first(objects, count)
                only = replace(self.settings, objects=(count,))
                check_places(
                    self.place.period,
                    self.routes,
                    some,
                    surroundings=around,
                    settings=only,
                )
        for under in dict.fromkeys(spec.context.under for spec in missing):
            make_environment(under.name, self.build_place(), under.conditions).close()

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


class EvaluateDriver(AbstractDriver):
    """Drives with the policy, or as the expert."""

    def __init__(self, work: EvaluateDrives) -> None:
        super().__init__()
        self._work = work
        self._place = work.build_place()
        self._policy = work.policy.build(self._place.rig.views)
        self._objects, self._surroundings = load_objects(work)

    def drive(self, spec: DriveSpec, on_step: OnStep) -> Drive:
        """Drive once."""
        under, route = spec.context
        blind = spec.case == EXPERT
        environment = self.environment.get(
            (under.label, blind), lambda: self._make(under, blind)
        )
        driver = self._expert(environment, route) if blind else self._policy
        settings = self._work.settings
        return evaluate_run(
            environment,
            driver,
            route,
            case=spec.case,
            run=spec.run,
            objects=self._work.first(self._objects, settings.counts.get(spec.case, 0)),
            surroundings=self._surroundings,
            settings=settings,
            on_step=on_step,
        )

    def _make(self, under: EnvironmentUnder, blind: bool) -> AbstractEnvironment:
        place, conditions = self._place, under.conditions
        if blind:
            place = place.with_rig(Rig.of_one(_EXPERT_CAMERA, place.mount))
            conditions = replace(conditions, spp=1)
        return make_environment(under.name, place, conditions)

    def _expert(self, environment: AbstractEnvironment, route: Route) -> ExpertPolicy:
        expert = expert_for(
            environment.control_unit,
            route,
            environment.period,
            max_control=environment.max_control,
            wheelbase=self._work.place.car.wheelbase,
            acceleration=acceleration_of(environment.more_controls),
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
    work: EvaluateDrives,
    workers: AbstractWorkers,
    progress: OnSteps = lambda done, total: None,
) -> Evaluation:
    """Do the drives that are not there yet, and summarise all.

    Args:
        work: all drives.
        workers: who does them.
        progress: called with control periods done and wanted.

    Raises:
        InputError: before the first drive, a lane is narrower than the car, or objects
            find no place. An environment cannot be made, CARLA is given several
            processes, or a drive in the folder is damaged. Later, the policy does not
            take the images.
    """
    limits = departure_limits(work.routes, work.settings.car_width_m)
    _check_workers(work, workers)
    files.make_folder(work.store.folder)
    drives: dict[tuple[str, str, str], list[Drive]] = {}
    seconds: dict[tuple[str, str], list[float]] = {}
    finished = run_drives(work, workers, progress)
    for [spec], [item] in zip(work.groups, finished, strict=True):
        case = spec.case
        drives.setdefault((spec.environment, spec.route, case), []).append(item.drive)
        seconds.setdefault((spec.environment, case), []).append(item.wall_s)
    means = {key: sum(values) / len(values) for key, values in seconds.items()}
    return Evaluation(make_card(drives, limits), drives, means)


def load_objects(
    work: EvaluateDrives,
) -> tuple[list[GridField], Surroundings | None]:
    """Load the objects of an evaluation and their surroundings, where it has any."""
    if work.cases == (NO_OBJECT,):
        return [], None
    site = PlaceSite(work.environments[0].name, work.place)
    # Routes of CARLA's leaderboard are XML, which only the evaluation has read
    read = work.routes if work.place.routes.suffix.lower() == ".xml" else ()
    return site.load_objects(work.settings.most), site.load_surroundings(read)


def _check_workers(work: EvaluateDrives, workers: AbstractWorkers) -> None:
    named = CARLA in (under.name for under in work.environments)
    if named and not isinstance(workers, InThisProcess):
        raise InputError(
            "workers: several processes for the environment 'carla', which would tick "
            "one server and could end without giving it back; 1 drives in this process"
        )


def check_policy(policy: AbstractPolicy, place: Place, routes: Sequence[Route]) -> None:
    """Show a policy a black image for every goal.

    Raises:
        InputError: the camera's image or a goal does not fit, or the place's car takes
            another number of controls.
    """
    width, height = place.rig.size
    shape = (1, height, width, 3)
    image, numbers = mi.TensorXf(np.zeros(shape, np.float32)), trial_numbers(policy)
    for route in routes:
        memory = policy.initial_memory(1)
        control, _ = policy.step(image, route.goal, memory, numbers)
        require_controls(control_size(control), place.car.control_names)


def _relative(name: str) -> str:
    """Drop the folder of an absolute path: it tells about the machine alone."""
    return Path(name).name if Path(name).is_absolute() else name
