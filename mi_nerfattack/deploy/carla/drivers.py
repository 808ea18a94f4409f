"""Ways to move a vehicle of CARLA by the controls of a policy."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.deploy.carla.cameras import read_pose
from mi_nerfattack.deploy.carla.conventions import (
    body_from_carla,
    body_to_carla,
    point_from_unreal,
    point_to_carla,
)
from mi_nerfattack.deploy.carla.session import CarlaSession
from mi_nerfattack.deploy.vehicle import AbstractVehicle, require_control
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Positive, checked

_KMH = 3.6  # km/h in one m/s
_CRAWL = 0.5  # m/s; a slower car is steered as one of this speed


@dataclass(frozen=True)
class Axles:
    """Where the axles of a vehicle are.

    Args:
        rear_m: x of the rear axle in the actor's frame, metres; mostly negative.
        wheelbase_m: from there to the front axle, metres.
    """

    rear_m: float
    wheelbase_m: float

    def body_to_world(self, actor_to_world: np.ndarray) -> np.ndarray:
        """Move a pose (4, 4) from the actor's origin to the rear axle."""
        return actor_to_world @ _shift(self.rear_m)

    def actor_to_world(self, body_to_world: np.ndarray) -> np.ndarray:
        """Move a pose (4, 4) from the rear axle to the actor's origin."""
        return body_to_world @ _shift(-self.rear_m)


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


class AbstractCarlaDriver(ABC):
    """Moves one vehicle, whose state refers to the middle of its rear axle.

    Attributes:
        max_control: largest control that has an effect.
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
    """

    max_control: float
    control_unit: str

    @abstractmethod
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

    @abstractmethod
    def release(self) -> None:
        """Let it drive at its nominal speed from the next tick on."""

    @abstractmethod
    def apply(self, control: float) -> None:
        """Order what the next tick does."""

    @abstractmethod
    def state(self, body_to_world: np.ndarray) -> np.ndarray:
        """Return the state (m,).

        Args:
            body_to_world: (4, 4), measured at the last tick, of the rear axle.
        """


class KinematicDriver(AbstractCarlaDriver):
    """Sets the pose by a model of ours, as the appendix did; no physics in CARLA.

    The vehicle stays level, on the lane that is nearest to where it was before: on a
    bridge it stays above what it crosses.

    Args:
        vehicle: the model.
    """

    def __init__(self, vehicle: AbstractVehicle) -> None:
        self.vehicle = vehicle
        self.max_control = vehicle.max_control
        self.control_unit = vehicle.control_unit

    def begin(
        self,
        session: CarlaSession,
        actor: Any,
        axles: Axles,
        pose: np.ndarray,
        speed: float,
        height: float,
    ) -> None:
        """Switch the actor's physics off."""
        self._session, self._actor, self._axles = session, actor, axles
        self._height = height
        self.vehicle.reset(pose, speed)
        actor.set_simulate_physics(False)
        self._place()

    def release(self) -> None:
        """Do nothing: the model drives from the first control on."""

    def apply(self, control: float) -> None:
        """Advance the model and set the pose."""
        self.vehicle.advance(control)
        self._place()

    def state(self, body_to_world: np.ndarray) -> np.ndarray:
        """Return the model's state."""
        del body_to_world
        return self.vehicle.state

    def _place(self) -> None:
        body = self.vehicle.body_to_world
        actor_to_world = self._axles.actor_to_world(body)
        actor_to_world[2, 3] = self._height
        self._height = road_height(self._session, actor_to_world)
        actor_to_world[2, 3] = self._height
        pose = body_to_carla(actor_to_world)
        self._actor.set_transform(self._session.transform(pose))


@dataclass(eq=False)
@checked("PhysicalDriver")
class PhysicalDriver(AbstractCarlaDriver):
    """Steers CARLA's own car to a heading rate, and keeps its speed by its pedals.

    The front wheels are set to ``atan(wheelbase u / v)``. A controller with
    proportional and integral part keeps the nominal speed.

    Args:
        max_heading_rate: largest control, radians per second.
        gain: throttle per m/s of missing speed.
        integral_gain: throttle per metre of missing way.
    """

    max_heading_rate: Positive = 1.5
    gain: Positive = 0.5
    integral_gain: Positive = 0.4

    control_unit = "rad/s"

    def __post_init__(self) -> None:
        self.max_control = self.max_heading_rate

    def begin(
        self,
        session: CarlaSession,
        actor: Any,
        axles: Axles,
        pose: np.ndarray,
        speed: float,
        height: float,
    ) -> None:
        """Read the car's steering, and brake."""
        del height  # its wheels stand on the road
        self._session, self._actor, self._axles = session, actor, axles
        self._speed, self._missing_m, self._heading = speed, 0.0, float(pose[2])
        self._period = session.world.get_settings().fixed_delta_seconds
        physics = actor.get_physics_control()
        self._max_steer_deg = max(wheel.max_steer_angle for wheel in physics.wheels)
        if not self._max_steer_deg > 0:
            raise InputError(f"{actor.type_id}: no wheel of it can be steered")
        curve = [(point.x, point.y) for point in physics.steering_curve]
        self._curve = np.array(sorted(curve) or [(0.0, 1.0)], np.float64)
        brakes = session.api.VehicleControl(brake=1.0, hand_brake=True)
        actor.apply_control(brakes)

    def release(self) -> None:
        """Let the car roll at its nominal speed."""
        along = [math.cos(self._heading), math.sin(self._heading), 0.0]
        velocity = point_to_carla(self._speed * np.array(along)).tolist()
        self._actor.set_target_velocity(self._session.api.Vector3D(*velocity))
        self._measured = False

    def apply(self, control: float) -> None:
        """Set steering wheel and pedals for the next period."""
        require_control(control)
        speed = self._speed  # a velocity that was set is not measured before a tick
        if self._measured:
            velocity = self._actor.get_velocity()
            speed = math.hypot(velocity.x, velocity.y)
        self._measured = True
        rate = float(np.clip(control, -self.max_control, self.max_control))
        pedal = self._pedal(speed)
        self._actor.apply_control(
            self._session.api.VehicleControl(
                throttle=max(pedal, 0.0),
                brake=max(-pedal, 0.0),
                steer=self.steer(rate, speed),
            )
        )

    def steer(self, heading_rate: float, speed: float) -> float:
        """Return CARLA's steering value in [-1, 1], positive to the right.

        Args:
            heading_rate: radians per second, positive to the left.
            speed: metres per second.
        """
        ratio = self._axles.wheelbase_m * heading_rate / max(speed, _CRAWL)
        share = np.interp(speed * _KMH, self._curve[:, 0], self._curve[:, 1])
        full_deg = self._max_steer_deg * float(share)
        return float(np.clip(-math.degrees(math.atan(ratio)) / full_deg, -1, 1))

    def state(self, body_to_world: np.ndarray) -> np.ndarray:
        """Return x, y and heading as measured."""
        forward = body_to_world[:2, 0]
        heading = math.atan2(forward[1], forward[0])
        return np.array([*body_to_world[:2, 3], heading])

    def _pedal(self, speed: float) -> float:
        error = self._speed - speed
        missing = self._missing_m + error * self._period
        pedal = self.gain * error + self.integral_gain * missing
        if abs(pedal) < 1:  # a pedal at its end must not wind the integral up
            self._missing_m = missing
        return float(np.clip(pedal, -1, 1))


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


def measured_body(transform: Any, axles: Axles) -> np.ndarray:
    """Return body_to_world (4, 4) of the rear axle for an actor's transform."""
    return axles.body_to_world(body_from_carla(read_pose(transform)))


def _shift(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix
