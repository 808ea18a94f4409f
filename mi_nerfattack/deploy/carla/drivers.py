"""A vehicle of CARLA that is moved by the controls of a policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.deploy.carla.conventions import (
    body_to_carla,
    point_from_unreal,
)
from mi_nerfattack.deploy.carla.session import CarlaSession
from mi_nerfattack.deploy.vehicle import AbstractVehicle, Controls
from mi_nerfattack.errors import InputError


@dataclass(frozen=True)
class Axles:
    """Where the axles of a vehicle are.

    Args:
        rear_m: x of the rear axle in the actor's frame, metres; mostly negative.
        wheelbase_m: from there to the front axle, metres.
    """

    rear_m: float
    wheelbase_m: float

    def body_to_world(
        self, actor_to_world: np.ndarray, reference: float = 0.0
    ) -> np.ndarray:
        """Move a pose (4, 4) from the actor's origin to a vehicle's `reference`."""
        return actor_to_world @ _shift(self.rear_m + reference)

    def actor_to_world(
        self, body_to_world: np.ndarray, reference: float = 0.0
    ) -> np.ndarray:
        """Move a pose (4, 4) from a vehicle's `reference` to the actor's origin."""
        return body_to_world @ _shift(-self.rear_m - reference)


def read_axles(actor: Any, actor_to_world: np.ndarray) -> Axles:
    """Find the axles from the positions of the wheels, which are Unreal's.

    Args:
        actor: a `carla.Vehicle`.
        actor_to_world: (4, 4), its pose at the last tick, metres.

    Raises:
        InputError: the positions are not those of a car, as with vehicles on two
            wheels or servers that report none.
    """
    wheels = actor.get_physics_control().wheels
    centres = np.array([[w.position.x, w.position.y, w.position.z] for w in wheels])
    along = np.zeros(0)
    if len(wheels) >= 4:
        local = point_from_unreal(centres) - actor_to_world[:3, 3]
        along = np.sort(local @ actor_to_world[:3, 0])
        rear, front = float(along[:2].mean()), float(along[-2:].mean())
        if -5 < rear < front < 5 and 0.5 < front - rear < 8:
            return Axles(rear, front - rear)
    raise InputError(
        f"{actor.type_id}: its wheels are {along.round(3).tolist()} m ahead of its "
        "origin, which is no car; give CarlaEnvironment(axles=Axles(...)) or take "
        "another vehicle"
    )


class KinematicDriver:
    """Sets the pose by a model of ours, as the appendix did; no physics in CARLA.

    The vehicle stays level, on the lane that is nearest to where it was before: on a
    bridge it stays above what it crosses.

    Args:
        vehicle: the model.

    Attributes:
        max_control: largest control that has an effect.
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
        more_controls: those after the first one.
    """

    def __init__(self, vehicle: AbstractVehicle) -> None:
        self.vehicle = vehicle
        self.max_control = vehicle.max_control
        self.control_unit = vehicle.control_unit
        self.more_controls = vehicle.more_controls

    def begin(
        self,
        session: CarlaSession,
        actor: Any,
        axles: Axles,
        pose: np.ndarray,
        speed: float,
        height: float,
    ) -> None:
        """Take over a vehicle that stands at a pose, and keep it there.

        Args:
            session: of its world.
            actor: a `carla.Vehicle`.
            axles: of it.
            pose: (3,), x and y in metres, heading in radians.
            speed: to be kept, metres per second.
            height: of the road there, metres.
        """
        self._session, self._actor, self._axles = session, actor, axles
        self._height = height
        self.vehicle.reset(pose, speed)
        actor.set_simulate_physics(False)
        self._place()

    def apply(self, control: Controls) -> None:
        """Advance the model and set the pose that the next tick shows."""
        self.vehicle.advance(control)
        self._place()

    def _place(self) -> None:
        body = self.vehicle.body_to_world
        actor_to_world = self._axles.actor_to_world(body, self.vehicle.reference)
        actor_to_world[2, 3] = self._height
        self._height = road_height(self._session, actor_to_world)
        actor_to_world[2, 3] = self._height
        pose = body_to_carla(actor_to_world)
        self._actor.set_transform(self._session.transform(pose))


def road_height(session: CarlaSession, actor_to_world: np.ndarray) -> float:
    """Return z of the lane nearest to an actor's pose (4, 4), also in height, metres.

    Raises:
        InputError: the town has no lane.
    """
    where = session.transform(body_to_carla(actor_to_world)).location
    waypoint = session.town_map.get_waypoint(where)
    if waypoint is None:
        raise InputError(f"{session.town_map.name}: no lane to drive on; take a town")
    return float(waypoint.transform.location.z)


def _shift(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix
