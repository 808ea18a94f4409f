"""Scenarios that the expert itself can drive: in its lane, clear of all objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.deploy.car import acceleration_of
from mi_nerfattack.deploy.registry import kinematic_vehicle
from mi_nerfattack.deploy.roadside.footprint import Shape
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.checks.standing import CAR_M
from mi_nerfattack.experiment.retrain.among import attacked_objects, found_place
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.world import initial_states
from mi_nerfattack.vehicle.expert import expert_for

_PER_SIDE = 16  # points of an outline


@dataclass(frozen=True)
class Driven:
    """How the expert drives past the objects of a run, from all starts of the run.

    Attributes:
        error_m: largest distance from the lane's centre.
        limit_m: beyond which a wheel is out of the lane.
        gap_m: least distance from the car's side to an object's box; below 0 it is hit.
    """

    error_m: float
    limit_m: float
    gap_m: float

    @property
    def trouble(self) -> str:
        """Why a policy cannot be asked to drive there; empty if it can."""
        if self.error_m > self.limit_m:
            return (
                f"the expert itself leaves its lane there, {self.error_m:.2f} m from "
                f"the centre ({self.limit_m:.2f} m allowed)"
            )
        if self.gap_m < 0:
            return f"an object stands {-self.gap_m:.2f} m in the expert's way"
        return ""


def drive_expert(attack: FoundAttack) -> Driven:
    """Let the expert drive a run's scenario; nothing is rendered.

    Raises:
        InputError: see :func:`among.found_place`, or no expert knows the vehicle.
    """
    place = found_place([attack])
    scenario, route, car = attack.scenario, attack.route, place.car
    if not scenario.vehicle.has_expert:
        raise InputError(
            f"{attack.folder}: vehicle.control_unit: is neither rad/s nor rad, and no "
            "expert drives such a vehicle; give it, and attack once more"
        )
    vehicle = kinematic_vehicle(place)
    expert = expert_for(
        car.control_unit,
        route,
        place.period,
        max_control=car.max_control,
        wheelbase=car.wheelbase,
        acceleration=acceleration_of(car.more_controls),
    )
    objects = [item for item in attacked_objects(attack) if _is_in_the_way(item)]
    outlines = np.concatenate([np.zeros((0, 2)), *map(_outline, objects)])
    errors, gaps = [], []
    for pose in initial_states(scenario, route, count=scenario.drive.runs, stream=0):
        vehicle.reset(pose, route.speed_ms)
        states = [vehicle.state[:3]]
        for _ in range(attack.horizon):
            vehicle.advance(expert.control(vehicle.state)[0])
            states.append(vehicle.state[:3])
        path = np.stack(states)
        errors.append(np.abs(route.cross_track_numpy(path[1:])).max())
        gaps.append(_distance(path[:, :2], outlines) - car.width / 2)
    return Driven(float(max(errors)), attack.lane.wheel_m, float(min(gaps)))


def _is_in_the_way(posed: PosedField) -> bool:
    """Whether a car cannot drive over an object."""
    assert isinstance(posed.field, GridField)
    top = posed.placed.apply(Shape.of(posed.field).upper[None])[0, 2]
    return bool(top > CAR_M[0])


def _outline(posed: PosedField) -> np.ndarray:
    """Return points (n, 2) on the ground around an object's occupied box, metres."""
    assert isinstance(posed.field, GridField)
    shape = Shape.of(posed.field)
    low, high = shape.lower[:2], shape.upper[:2]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    share = np.arange(_PER_SIDE)[:, None] / _PER_SIDE
    sides = [
        corner + share * (after - corner)
        for corner, after in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    points = np.concatenate(sides)
    local = np.column_stack([points, np.full(len(points), shape.lower[2])])
    return posed.placed.apply(local)[:, :2]


def _distance(path: np.ndarray, points: np.ndarray) -> float:
    """Return the least distance of points (n, 2) from a path (m, 2), metres."""
    begin, along = path[:-1], np.diff(path, axis=0)
    square = np.maximum((along**2).sum(1), 1e-12)
    away = points[:, None] - begin
    share = np.clip((away * along).sum(2) / square, 0, 1)
    distances = np.linalg.norm(away - share[..., None] * along, axis=2)
    return float(distances.min(initial=np.inf))


def divide_solvable(
    attacks: Sequence[FoundAttack],
) -> tuple[list[FoundAttack], dict[str, str]]:
    """Divide runs into those that the expert can drive, and others.

    Returns:
        the former; and by label why each of the latter cannot count.
    """
    solvable, others = [], {}
    for attack in attacks:
        if trouble := drive_expert(attack).trouble:
            others[attack.label] = trouble
        else:
            solvable.append(attack)
    return solvable, others
