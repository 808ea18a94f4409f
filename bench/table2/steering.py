"""How hard a policy steers back to the lane, and how large objects are to it."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.deploy.driving import policy_image
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.checks.before_attack import changeable_share
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, OWN, RANDOM
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import World
from mi_nerfattack.vehicle.state import to_state

EVERY = 4  # control periods
ASIDE_M, TURNED_RAD = 0.2, 0.05
UNIT = "rad/s"  # of the control
NEAR_M = 0.15  # two drives that see alike
CASES = (NO_OBJECT, RANDOM, ATTACK)
HEADER = [
    *("route", "places", "objects' share of the image, %", "at most"),
    *(f"steers back, {UNIT} per m", "at the least", "there, m along", "per rad"),
    *("unperturbed, m", "random, m", "attack, m", "attack less random"),
]
CHANGED = ["route", "attacks", f"changes the control by, {UNIT}", "there, m along"]


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
    sensor, period_m = world.without_objects(), route.speed_ms * place.period

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


def largest_change(path: Path, period_m: float) -> dict[str, float]:
    """Return by how much an attack changes the control at most, and where.

    Its drives in the surrogate are set beside those past the objects as they are, from
    the same starts, step by step, while the places of both are within `NEAR_M`.

    Args:
        path: ``steps.csv`` of its run folder.
        period_m: metres driven in a control period.

    Returns:
        ``control`` and ``along_m``.
    """
    drives: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row in csv.DictReader(files.read_text(path).splitlines()):
        if row["environment"] == SURROGATE:
            values = float(row["control"]), float(row["cross_track_m"])
            drives.setdefault((row["case"], row["run"]), []).append(values)
    found = []
    for (case, run), rows in drives.items():
        if case == ATTACK:
            attacked, own = np.array(rows), np.array(drives[OWN, run])
            controls, aside = np.abs(attacked - own).T
            # the frame of a control was taken where the step before had ended
            near = np.append(0, aside[:-1]) < NEAR_M
            step = int(np.where(near, controls, -1).argmax())
            found.append({"control": controls[step], "along_m": step * period_m})
    return max(found, key=lambda change: change["control"])


def changed_lines(places: Sequence[Mapping[str, Any]]) -> Iterator[Sequence[str]]:
    """Yield a line a route of a table with `CHANGED`: least and most of its attacks."""
    for route in dict.fromkeys(place["route"] for place in places):
        own = [p["change"] for p in places if p["route"] == route and "change" in p]
        if own:
            controls = sorted(change["control"] for change in own)
            along = sorted(change["along_m"] for change in own)
            yield (
                *(route, str(len(own)), f"{controls[0]:.2f} to {controls[-1]:.2f}"),
                f"{along[0]:.1f} to {along[-1]:.1f}",
            )
