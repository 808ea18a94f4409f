"""How hard a policy steers back to the lane, and how large objects are to it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mi_nerfattack.backend.threads import one_thread
from mi_nerfattack.deploy.driving import policy_image
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.checks.before_attack import changeable_share
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, RANDOM
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import World
from mi_nerfattack.vehicle.state import to_state

EVERY = 4  # control periods
ASIDE_M, TURNED_RAD = 0.2, 0.05
UNIT = "rad/s"  # of the control
CASES = (NO_OBJECT, RANDOM, ATTACK)
HEADER = [
    *("route", "places", "objects' share of the image, %", "at most"),
    *(f"steers back, {UNIT} per m", "at the least", "there, m along", "per rad"),
    *("unperturbed, m", "random, m", "attack, m", "attack less random"),
]


def measure(world: World) -> list[dict[str, float]]:
    """Look from along the route's centre, every `EVERY` periods of a drive.

    Returns:
        of each look ``along_m``, arc length; ``share`` of the pixels that textures can
        change; ``per_m`` and ``per_rad``, by how much the policy's control, without
        objects, changes against `ASIDE_M` to the left and `TURNED_RAD` (half the
        difference to as much to the right).

    Raises:
        InputError: the vehicle's control is no heading rate.
    """
    drive, route, place = world.scenario.drive, world.route, world.place
    if place.car.control_unit != UNIT:
        raise InputError(
            f"{world.scenario.name!r}: its control is in {place.car.control_unit}; "
            f"give a sweep with a vehicle steered in {UNIT}"
        )
    sensor, period_m = world.surrogate.showing([]), route.speed_ms * place.period

    def control(pose: np.ndarray, step: int) -> float:
        seen = np.array(sensor.observe(to_state(pose[None]), step).image)[0]
        image = policy_image(np.round(255 * seen).astype(np.uint8))
        memory = world.policy.initial_memory(1)
        return float(np.array(world.policy.step(image, route.goal, memory)[0])[0])

    looks = []
    with one_thread():
        for step in range(0, world.horizon, EVERY):
            along = drive.start_m + step * period_m
            here = route.pose_at(along)
            aside = route.pose_at(along, [ASIDE_M, -ASIDE_M])
            turned = route.pose_at(along, 0, [TURNED_RAD, -TURNED_RAD])
            left, right, in_, out = (control(p, step) for p in (*aside, *turned))
            looks.append(
                {
                    "along_m": along,
                    "share": changeable_share(world, world.fields, here, step),
                    "per_m": (right - left) / (2 * ASIDE_M),
                    "per_rad": (out - in_) / (2 * TURNED_RAD),
                }
            )
    return looks


def errors(rows: Iterable[Mapping[str, Any]], cell: str) -> dict[str, float]:
    """Return the mean errors of a cell in the surrogate by case."""
    found: dict[str, list[float]] = {case: [] for case in CASES}
    for row in rows:
        if (row["cell"], row["environment"]) == (cell, SURROGATE):
            if row["case"] in found:
                found[row["case"]].append(row["cross_track_mean_m"])
    return {case: float(np.mean(values)) for case, values in found.items()}


def lines(places: Sequence[Mapping[str, Any]]) -> Iterator[Sequence[str]]:
    """Yield a line a route of a table with `HEADER`: means, the most and the least."""
    for route in dict.fromkeys(place["route"] for place in places):
        own = [place for place in places if place["route"] == route]
        looks = [look for place in own for look in place["looks"]]
        mean = {case: np.mean([place[case] for place in own]) for case in CASES}
        for name in ("share", "per_m", "per_rad"):
            mean[name] = np.mean([look[name] for look in looks])
        least = min(looks, key=lambda look: look["per_m"])
        yield (
            *(route, str(len(own)), f"{100 * mean['share']:.1f}"),
            f"{100 * max(look['share'] for look in looks):.1f}",
            *(f"{mean['per_m']:.2f}", f"{least['per_m']:.2f}"),
            *(f"{least['along_m']:.0f}", f"{mean['per_rad']:.2f}"),
            *(f"{mean[case]:.3f}" for case in CASES),
            f"{mean[ATTACK] - mean[RANDOM]:.3f}",
        )
