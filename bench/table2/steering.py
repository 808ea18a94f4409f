"""How hard a policy steers back to the lane, and how large objects are to it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mi_nerfattack.backend.threads import one_thread
from mi_nerfattack.deploy.driving import policy_image
from mi_nerfattack.experiment.checks.before_attack import changeable_share
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, RANDOM
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import World
from mi_nerfattack.vehicle.state import to_state

EVERY = 4  # control periods
ASIDE_M, TURNED_RAD = 0.2, 0.05
CASES = (NO_OBJECT, RANDOM, ATTACK)
HEADER = [
    *("route", "places", "objects' share of the image, %", "at most"),
    *("steers back, rad/s per m", "at the least", "per rad"),
    *("unperturbed, m", "random, m", "attack, m", "attack less random"),
]


def measure(world: World) -> dict[str, float]:
    """Look from along the route's centre, at the speed of the drive, every 0.4 s.

    Returns:
        ``share`` and ``share_most`` of the pixels that textures change by 0.1 or more;
        ``per_m`` and ``per_rad``, the policy's control against a place 0.2 m aside and
        a heading 0.05 rad off, without objects, central differences, and the least of
        the former, ``per_m_least``; means else.
    """
    drive, route = world.scenario.drive, world.route
    sensor = world.surrogate.showing([])
    ahead_m = route.speed_ms * world.scenario.vehicle.dt_s
    shares, aside, turned = [], [], []

    def control(pose: np.ndarray, step: int) -> float:
        seen = np.array(sensor.observe(to_state(pose[None]), step).image)[0]
        image = policy_image(np.round(255 * seen).astype(np.uint8))
        memory = world.policy.initial_memory(1)
        return float(np.array(world.policy.step(image, route.goal, memory)[0])[0])

    def back(shift: np.ndarray, pose: np.ndarray, step: int) -> float:
        sides = control(pose - shift, step) - control(pose + shift, step)
        return sides / (2 * float(np.linalg.norm(shift)))

    with one_thread():
        for step in range(0, world.horizon, EVERY):
            pose = np.asarray(route.pose_at(drive.start_m + step * ahead_m))
            left = np.array([-np.sin(pose[2]), np.cos(pose[2]), 0])
            shares.append(changeable_share(world, world.fields, pose, step))
            aside.append(back(ASIDE_M * left, pose, step))
            turned.append(back(np.array([0, 0, TURNED_RAD]), pose, step))
    return {
        "share": float(np.mean(shares)),
        "share_most": max(shares),
        "per_m": float(np.mean(aside)),
        "per_m_least": min(aside),
        "per_rad": float(np.mean(turned)),
    }


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
        mean = {
            name: float(np.mean([place[name] for place in own]))
            for name in ("share", "per_m", "per_rad", *CASES)
        }
        yield (
            *(route, str(len(own)), f"{100 * mean['share']:.1f}"),
            f"{100 * max(place['share_most'] for place in own):.1f}",
            f"{mean['per_m']:.2f}",
            f"{min(place['per_m_least'] for place in own):.2f}",
            f"{mean['per_rad']:.2f}",
            *(f"{mean[case]:.3f}" for case in CASES),
            f"{mean[ATTACK] - mean[RANDOM]:.3f}",
        )
