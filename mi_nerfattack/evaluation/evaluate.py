"""Closed-loop error of a policy in deployment environments: its card."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.deploy.environment import AbstractEnvironment, drive
from mi_nerfattack.deploy.place import Scatter
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import card_figures
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.random_textures import random_texture
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.ranges import Count, Natural, checked
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.drive import (
    EXPERT,
    NO_OBJECT,
    Drive,
    departure_limits,
    random_case,
)
from mi_nerfattack.system.workers import tally
from mi_nerfattack.vehicle.dynamics import controls_as, to_control
from mi_nerfattack.vehicle.expert import AbstractExpert
from mi_nerfattack.vehicle.route.route import Route

#: Of the starts: 0.25 m and 3 degrees, cut at three times as much.
STARTS = Scatter(
    lateral_sd_m=0.25,
    lateral_max_m=0.75,
    heading_sd=np.deg2rad(3.0).item(),
    heading_max=np.deg2rad(9.0).item(),
    close_share=0.0,
)


@dataclass(frozen=True)
@checked("EvaluateSettings")
class EvaluateSettings:
    """Choices of an evaluation; the same settings give the same drives.

    The start of a drive depends on seed, route and number of the drive alone. Places
    and textures also depend on the number of objects. All are the same in every
    environment. More runs or numbers of objects add drives and change none.

    Args:
        runs: drives of each route, environment and case.
        objects: numbers of objects with random textures at the roadside, one case per
            number; every route is driven without objects, too.
        seed: of starts, places and textures.
        margin_m: arc length before the end of an open route at which a drive ends.
        horizon: most steps of a drive.
        scatter: of the starts.
        car_width_m: for departures from the lane.
        roadside: the rule by which the objects stand.
    """

    runs: Count = 20
    objects: tuple[Natural, ...] = (1,)
    seed: Natural = 0
    margin_m: float = 2.0
    horizon: Count = 1000
    scatter: Scatter = STARTS
    car_width_m: float = 1.8
    roadside: Roadside = field(default_factory=Roadside)

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases, that without objects first."""
        return tuple(self.counts)

    @property
    def counts(self) -> dict[str, int]:
        """Number of objects of each case, ascending."""
        several = sorted(set(self.objects) - {0})
        return {NO_OBJECT: 0, **{random_case(count): count for count in several}}

    @property
    def most(self) -> int:
        """The largest number of objects."""
        return max(self.counts.values())

    def steps(self, route: Route, period: float = 0.1) -> int:
        """Return the number of steps of `period` seconds of a drive, at least 1."""
        length = route.length - (0.0 if route.closed else self.margin_m)
        count = int(length / (route.speed_ms * period) + 1e-6)
        return max(1, min(self.horizon, count))


class ExpertPolicy(AbstractPolicy):
    """Driver that uses an environment's state instead of the images.

    Args:
        environment: in which it drives.
        expert: of its route and its unit of control.
    """

    differentiable = False

    def __init__(
        self, environment: AbstractEnvironment, expert: AbstractExpert
    ) -> None:
        self.environment, self.expert = environment, expert

    def control(self, image: Any, goal: Any) -> Any:
        """Ask the expert."""
        del image, goal
        control = self.expert.control(self.environment.state)
        return controls_as(mi.Float, to_control(control.reshape(1, -1)))

    def vjp(self, image: Any, goal: Any, cotangent: Any) -> tuple[Any, Any]:
        """Refuse: what it sees is no image."""
        raise InputError("the expert sees no image and has no derivative")


def random_start(
    route: Route, settings: EvaluateSettings, rng: np.random.Generator
) -> np.ndarray:
    """Draw a pose (3,) near the start of a route, metres and radians."""
    return settings.scatter.states(route, np.zeros(1), rng)[0]


def drawn_start(
    settings: EvaluateSettings, route: Route, run: int
) -> tuple[np.ndarray, int]:
    """Return the pose (3,) from which a drive starts, and its seed."""
    rng = _generator(settings, route, run, objects=0)
    return random_start(route, settings, rng), int(rng.integers(2**31))


def evaluate_run(
    environment: AbstractEnvironment,
    policy: AbstractPolicy,
    route: Route,
    case: str,
    run: int,
    objects: Sequence[GridField],
    surroundings: Surroundings | None,
    settings: EvaluateSettings,
    on_step: Callable[[int], None] | None = None,
) -> Drive:
    """Drive once from a random start, alone or with objects of random texture.

    Args:
        environment: shows nothing but its world afterwards.
        policy: drives.
        route: from its start.
        case: one of the cases of `settings`, or `EXPERT`.
        run: number of the drive, from 0.
        objects: fields of the roadside objects, used in turns; they have their
            original textures again at the end.
        surroundings: of the objects; None in the case without objects.
        settings: of the evaluation.
        on_step: called after each step.
    """
    pose, seed = drawn_start(settings, route, run)
    steps = settings.steps(route, environment.period)
    count = 0 if case == EXPERT else settings.counts[case]
    with own_textures(objects if count else ()):
        posed = place_objects(
            environment.period,
            route,
            count,
            run=run,
            objects=objects,
            surroundings=surroundings,
            settings=settings,
        )
        environment.show(posed)
        try:
            with one_thread():
                return drive(
                    environment,
                    policy,
                    route,
                    pose=pose,
                    seed=seed,
                    steps=steps,
                    on_step=on_step,
                    case=case,
                    run=run,
                )
        finally:
            environment.show([])


def evaluate(
    policy: AbstractPolicy,
    environments: Sequence[AbstractEnvironment],
    routes: Sequence[Route],
    objects: Sequence[GridField],
    surroundings: Surroundings | None,
    settings: EvaluateSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Drive every route in every environment, and return the card.

    Args:
        policy: drives.
        environments: with different names.
        routes: with different names.
        objects: at least `settings.most` of them; none: no case with objects.
        surroundings: of the objects; may be None without.
        settings: see there.
        progress: called after each step of a drive.

    Returns:
        {ENVIRONMENT: {ROUTE: {CASE: figures}}}, see `make_card`.

    Raises:
        InputError: before the first drive, a lane that is too narrow for the car or
            objects that find no place; then whatever a drive raises.
    """
    cases = settings.cases if objects else (NO_OBJECT,)
    limits = departure_limits(routes, settings.car_width_m)
    if objects:
        for environment in environments:
            period = environment.period
            check_places(
                period, routes, objects, surroundings=surroundings, settings=settings
            )
    jobs = [
        (environment, route, case, run)
        for environment in environments
        for route in routes
        for case in cases
        for run in range(settings.runs)
    ]
    total = sum(settings.steps(route, env.period) for env, route, _, _ in jobs)
    drives: dict[tuple[str, str, str], list[Drive]] = {}
    count = tally(progress, 0, total)
    for environment, route, case, run in jobs:
        driven = evaluate_run(
            environment,
            policy,
            route,
            case=case,
            run=run,
            objects=objects,
            surroundings=surroundings,
            settings=settings,
            on_step=lambda step: count(1),
        )
        drives.setdefault((environment.name, route.name, case), []).append(driven)
    return make_card(drives, limits)


def make_card(
    drives: Mapping[tuple[str, str, str], Sequence[Drive]],
    limits: Mapping[str, float],
) -> dict[str, Any]:
    """Summarise drives, with the expert's figures next to the policy's.

    Args:
        drives: by environment, route and case.
        limits: departure limit of each route, metres.

    Returns:
        {ENVIRONMENT: {ROUTE: {CASE: figures}}} of JSON types, in the order of the
        drives. The figures are those of `card_figures`. The case without objects also
        has the figures of the expert as `expert`, None where the expert does not drive.
    """
    card: dict[str, Any] = {}
    for (label, route, case), group in drives.items():
        if case == EXPERT:
            continue
        figures = card_figures(group, limits[route])
        expert = drives.get((label, route, EXPERT))
        if case == NO_OBJECT:
            expert_figures = card_figures(expert, limits[route]) if expert else None
            names = ("n", "cross_track_mean_m", "cross_track_max_m", "drives_departed")
            figures["expert"] = expert_figures and {
                name: expert_figures[name] for name in names
            }
        card.setdefault(label, {}).setdefault(route, {})[case] = figures
    return card


@contextmanager
def own_textures(objects: Sequence[GridField]) -> Iterator[None]:
    """Give objects their original textures back at the end."""
    own = [item.texture.numpy().copy() for item in objects]
    try:
        yield
    finally:
        for item, texture in zip(objects, own, strict=True):
            item.set_parameter("texture", texture)


def check_places(
    period: float,
    routes: Sequence[Route],
    objects: Sequence[GridField],
    surroundings: Surroundings | None,
    settings: EvaluateSettings,
) -> None:
    """Draw the places of all drives.

    Args:
        period: seconds between two images.
        routes: that are driven.
        objects: all that there are.
        surroundings: theirs.
        settings: see there.

    Raises:
        InputError: the objects are too few, or do not find a place.
    """
    with own_textures(objects):
        for route in routes:
            for count in settings.counts.values():
                for run in range(settings.runs):
                    place_objects(
                        period,
                        route,
                        count,
                        run=run,
                        objects=objects,
                        surroundings=surroundings,
                        settings=settings,
                    )


def place_objects(
    period: float,
    route: Route,
    count: int,
    run: int,
    objects: Sequence[GridField],
    surroundings: Surroundings | None,
    settings: EvaluateSettings,
) -> list[PosedField]:
    """Give some objects random textures, and put them at the roadside.

    Args:
        period: seconds between two images.
        route: of the drive.
        count: how many objects.
        run: number of the drive; other runs begin with other objects.
        objects: all that there are; they get the textures.
        surroundings: of the objects; None without objects.
        settings: of the evaluation.

    Raises:
        InputError: the objects are too few, or do not find a place.
    """
    if not count:
        return []
    if count > len(objects) or surroundings is None:
        raise InputError(
            f"EvaluateSettings.objects: {count}, and {len(objects)} fields are there; "
            "each object needs a field of its own and a scene to stand in; or 0"
        )
    rng = _generator(settings, route, run, objects=count)
    kinds = sorted((run + index) % len(objects) for index in range(count))
    fields = [objects[kind] for kind in kinds]
    for item in fields:
        texture = random_texture(item, "mixed", int(rng.integers(2**31)))
        item.set_parameter("texture", texture)
    rule = settings.roadside
    # a horizon too near for objects to be seen does not bring them nearer
    horizon = max(settings.horizon, math.ceil(rule.view_s / period))
    steps = replace(settings, horizon=horizon).steps(route, period)
    stretch = 0.0, (steps - 1) * route.speed_ms * period
    poses = rule.draw(
        fields, surroundings, route, stretch=stretch, rng=rng, kinds=kinds
    )
    return [PosedField(item, pose) for item, pose in zip(fields, poses, strict=True)]


def _generator(
    settings: EvaluateSettings, route: Route, run: int, objects: int
) -> np.random.Generator:
    """Return the source of the draws of a drive, or of its objects."""
    name = zlib.crc32(route.name.encode())
    entropy = [settings.seed, name, run]
    return np.random.default_rng([*entropy, objects] if objects else entropy)
