"""Closed-loop error of a policy: its card before any attack."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.table import Table

from mi_nerfattack.attack.textures import random_texture
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.collect import World
from mi_nerfattack.policy.placement import Roadside
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.report.metrics import Drive, departure_limit, summarise
from mi_nerfattack.report.table import metrics_table
from mi_nerfattack.rollout.loop import ClosedLoop, simulate, to_state
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import RK4
from mi_nerfattack.vehicle.route import Route

#: Called with steps done and steps wanted, of all drives.
OnSteps = Callable[[int, int], None]


@dataclass(frozen=True)
class EvaluateSettings:
    """Choices of a validation; the same settings and world give the same drives.

    Args:
        runs: drives at the same time, from scattered initial poses.
        objects: in how many places, each with a random texture, an object stands.
        seed: of poses, places and textures.
        dt: seconds.
        margin_m: arc length before the end of the route at which a drive ends.
        horizon: most steps of a drive.
        lateral_sd_m: scatter of the initial offset, metres.
        heading_sd: scatter of the initial heading, radians.
        ahead_m: arc length from a drive's start to the object, least and, measured
            back from its end, most.
        car_width_m: for departures from the lane.
        roadside: sizes and places of the objects.
    """

    runs: int = 4
    objects: int = 3
    seed: int = 0
    dt: float = 0.1
    margin_m: float = 2.0
    horizon: int = 1000
    lateral_sd_m: float = 0.1
    heading_sd: float = 0.02
    ahead_m: tuple[float, float] = (8.0, 2.0)
    car_width_m: float = 1.8
    roadside: Roadside = field(default_factory=Roadside)

    def steps(self, route: Route) -> int:
        """Return the number of steps of a drive along a route, at least 1."""
        length = route.length - self.margin_m
        return max(1, min(self.horizon, int(length / (route.speed_ms * self.dt))))


def drive_routes(
    policy: Any,
    worlds: Sequence[World],
    routes: Sequence[Route],
    settings: EvaluateSettings,
    progress: OnSteps = lambda done, total: None,
) -> list[Drive]:
    """Drive every route in every world, alone and past objects of random texture.

    Args:
        policy: AbstractPolicy.
        worlds: named "surrogate" or "deployment"; without objects no random case.
        routes: each is driven from its first point.
        settings: see there.
        progress: called after each step of a batch.

    Returns:
        `runs` drives of case "unperturbed" and `runs * objects` of case "random" for
        each world and route.
    """
    cases = {world.name: bool(world.objects) * settings.objects for world in worlds}
    total = sum(
        (1 + cases[world.name]) * settings.steps(route)
        for world in worlds
        for route in routes
    )
    done, drives = 0, []

    def count(step: int) -> None:
        nonlocal done
        done += 1
        progress(done, total)

    for world in worlds:
        for route in routes:
            drives += _drive_batch(policy, world, route, settings, 0, count)
            own = [item.texture.numpy() for item in world.objects]
            try:
                for number in _decorate(world, route, settings, cases[world.name]):
                    drives += _drive_batch(
                        policy, world, route, settings, number, count
                    )
            finally:
                world.sensor.objects = []
                for item, texture in zip(world.objects, own, strict=True):
                    item.set_parameter("texture", texture)
    return drives


def policy_card(
    drives: Sequence[Drive], routes: Sequence[Route], car_width_m: float = 1.8
) -> dict[str, Any]:
    """Summarise drives by route, world and case; see `report.metrics.summarise`."""
    limits = {
        route.name: departure_limit(route.lane_width_m, car_width_m) for route in routes
    }
    return {"routes": summarise(drives, limits)}


def card_table(card: Mapping[str, Any]) -> Table:
    """Return a card as a table for a terminal."""
    return metrics_table(card)


def _decorate(
    world: World, route: Route, settings: EvaluateSettings, count: int
) -> Iterator[int]:
    """Set up one object with a random texture after the other, numbered from 1."""
    length = settings.steps(route) * settings.dt * route.speed_ms
    first, before = settings.ahead_m
    if count and first > length - before:
        raise InputError(
            f"EvaluateSettings.ahead_m: {settings.ahead_m}; a drive on "
            f"{route.name!r} has {length:.1f} m"
        )
    for number in range(1, count + 1):
        # the same places and textures in every world
        rng = np.random.default_rng([settings.seed, route.goal, number])
        item = world.objects[number % len(world.objects)]
        item.set_parameter(
            "texture", random_texture(item, "mixed", int(rng.integers(2**31)))
        )
        reach = (first, length - before)
        pose = settings.roadside.place(item, route, reach, world.ground, rng)
        world.sensor.objects = [PosedField(item, pose)]
        yield number


def _drive_batch(
    policy: Any,
    world: World,
    route: Route,
    settings: EvaluateSettings,
    number: int,
    on_step: Callable[[int], None],
) -> list[Drive]:
    """Drive `runs` vehicles past what the world has; number 0 is without objects."""
    runs = settings.runs
    rng = np.random.default_rng([settings.seed, route.goal, 0])
    lateral = settings.lateral_sd_m * rng.standard_normal(runs)
    heading = settings.heading_sd * rng.standard_normal(runs)
    initial = route.pose_at(np.zeros(runs), lateral, heading)
    if number == 0:
        world.sensor.objects = []
    dynamics = Dubins(speed=route.speed_ms)
    loop = ClosedLoop(world.sensor, policy, route.goal, dynamics, RK4(), settings.dt)
    steps = settings.steps(route)
    trajectory = simulate(loop, to_state(initial), steps, on_step)
    states, controls = trajectory.states_numpy(), trajectory.controls_numpy()
    return [
        Drive(
            environment=world.name,
            route=route.name,
            case="random" if number else "unperturbed",
            run=run + max(0, number - 1) * runs,
            seed=settings.seed,
            states=states[run],
            controls=controls[run],
            cross_track_m=route.cross_track_numpy(states[run, 1:]),
            time_s=settings.dt * np.arange(1, steps + 1),
        )
        for run in range(runs)
    ]
