"""A car with wheels, tyres and motors in MuJoCo."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.deploy.car import Car, acceleration_of
from mi_nerfattack.deploy.mujoco import car as mjcf_car
from mi_nerfattack.deploy.mujoco.car import Handling
from mi_nerfattack.deploy.mujoco.module import mujoco
from mi_nerfattack.deploy.vehicle import (
    AbstractVehicle,
    Controls,
    checked_control,
    checked_pose,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Positive, checked
from mi_nerfattack.vehicle.steering import steering_angle

_SETTLE_S = 2.0
_SPEED_GAIN = 2.0  # 1/s
_SPEED_INTEGRAL_GAIN = 1.0  # 1/s^2


@dataclass(frozen=True)
@checked()
class AbstractSteering(ABC):
    """What a control means.

    Args:
        max_control: largest control that has an effect.
    """

    max_control: Positive

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of the control: "rad/s" or "rad"."""

    @abstractmethod
    def angle(self, control: float, speed: float, wheelbase: float) -> float:
        """Return the steering angle, radians.

        Args:
            control: within `max_control`.
            speed: nominal, metres per second.
            wheelbase: metres.
        """


@dataclass(frozen=True)
class HeadingRate(AbstractSteering):
    """Steering by a heading rate u at nominal speed v: the angle is atan(l u / v)."""

    max_control: float = 1.5

    @property
    def unit(self) -> str:
        """Radians per second."""
        return "rad/s"

    def angle(self, control: float, speed: float, wheelbase: float) -> float:
        """Return the angle whose circle has the curvature u / v, radians."""
        return float(steering_angle(control, speed, wheelbase))


@dataclass(frozen=True)
class SteeringAngle(AbstractSteering):
    """Steering by the angle of the bicycle model itself."""

    max_control: float = 0.34

    @property
    def unit(self) -> str:
        """Radians."""
        return "rad"

    def angle(self, control: float, speed: float, wheelbase: float) -> float:
        """Return the control, radians."""
        del speed, wheelbase
        return control


_STEERING = {cls(1.0).unit: cls for cls in (HeadingRate, SteeringAngle)}


class MujocoVehicle(AbstractVehicle):
    """Car on the plane z = 0 with tyre friction, steering lag and motor lag.

    The commanded steering angle is limited to `car.max_steer` and in its rate, then
    follows a first-order lag. A controller holds the speed of the rear axle, as the
    wheels measure it, through a motor with a lag of its own. All of it is
    deterministic: equal controls give equal bits.

    Where the car takes an acceleration, too, this changes the speed to hold, but never
    below 0; motor and brakes act on the rear wheels, whose grip limits both.

    The state is (x, y, theta, speed, steering angle, heading rate). x and y are of the
    point on the ground that `car.reference` names, by default under the middle of the
    rear axle. x and y are in metres, and theta is in radians and not wrapped. The speed
    is that of the rear axle along the car, in metres per second. The steering angle is
    in radians and the heading rate in radians per second.

    Args:
        car: dimensions.
        steering: what a control means; None for what the car says.
        period: seconds that a control is held; a multiple of `timestep`.
        handling: lags, limits and friction.
        timestep: of the physics, seconds, at most 0.002.

    Raises:
        InputError: the period is no multiple of the timestep, or the timestep is out
            of range. Also where the car steers about a point between its rear wheels,
            or has a control besides steering and an acceleration.
    """

    def __init__(
        self,
        car: Car,
        steering: AbstractSteering | None = None,
        period: float = 0.1,
        handling: Handling | None = None,
        timestep: float = mjcf_car.MAX_TIMESTEP,
    ) -> None:
        self.car, self.handling = car, handling or Handling()
        if steering is None and car.control_unit not in _STEERING:
            raise InputError(
                f"car.control_unit: {car.control_unit!r}; a car with wheels takes "
                f"{' or '.join(_STEERING)}, or give steering"
            )
        self.steering = steering or _STEERING[car.control_unit](car.max_control)
        self.max_control = self.steering.max_control
        self.control_unit = self.steering.unit
        self.reference = car.reference
        self.more_controls, force = (
            car.more_controls,
            acceleration_of(car.more_controls),
        )
        if len(self.more_controls) != (force is not None):
            raise InputError(
                f"car.more_controls: {', '.join(self.control_names[1:])}; a car with "
                "wheels takes an acceleration after its steering, or nothing"
            )
        most = self.handling.max_acceleration
        self._force: tuple[float, float] = force or (-most, most)
        self._substeps = _count_substeps(period, timestep)
        spec = mujoco.MjSpec()
        mjcf_car.add_ground(spec)
        mjcf_car.add_car(spec, car, self.handling)
        spec.option.timestep = timestep
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._settled = self._settle()
        self._speed: float | None = None
        self._steer = self._excess = self._theta = 0.0

    def reset(self, pose: np.ndarray, speed: float, seed: int = 0) -> None:
        """Put the car on the ground, rolling straight ahead; `seed` has no effect."""
        del seed
        if not 0 <= speed < float("inf"):
            raise InputError(f"speed: {speed!r} m/s; a finite number of at least 0")
        x, y, theta = checked_pose(pose).tolist()
        ahead = self.reference
        data = self._data
        mujoco.mj_resetData(self._model, data)
        data.qpos[:] = self._settled
        body = data.joint(mjcf_car.BODY)
        body.qpos[:2] = x - ahead * math.cos(theta), y - ahead * math.sin(theta)
        body.qpos[3:] = math.cos(theta / 2), 0, 0, math.sin(theta / 2)
        body.qvel[:2] = speed * math.cos(theta), speed * math.sin(theta)
        for name in mjcf_car.WHEELS:
            data.joint(name).qvel[0] = speed / self.car.wheel_radius
        mujoco.mj_forward(self._model, data)
        self._speed, self._theta = float(speed), theta
        self._steer = self._excess = 0.0

    def advance(self, control: Controls) -> None:
        """Drive one period."""
        if self._speed is None:
            raise InputError("vehicle: advance comes after reset")
        steer, *others = checked_control(control, self.control_names).tolist()
        limited = min(max(steer, -self.max_control), self.max_control)
        acceleration = (
            min(max(others[0], self._force[0]), self._force[1]) if others else 0.0
        )
        angle = self.steering.angle(limited, self._speed, self.car.wheelbase)
        angle = min(max(angle, -self.car.max_steer), self.car.max_steer)
        for _ in range(self._substeps):
            before = self._speed
            self._speed = max(0.0, before + acceleration * self._model.opt.timestep)
            self._substep(angle, self._speed, self._speed - before)
        turn = self._heading() - self._theta
        self._theta += math.remainder(turn, 2 * math.pi)

    @property
    def state(self) -> np.ndarray:
        """State (6,), see the class."""
        self._require_reset()
        data = self._data
        body, rotation = data.joint(mjcf_car.BODY), self._rotation()
        return np.array(
            [
                *self.body_to_world[:2, 3],
                self._theta,
                body.qvel[:3] @ rotation[:, 0],
                data.joint(mjcf_car.COLUMN).qpos[0],
                body.qvel[3:] @ rotation[2],  # angular velocity is in the body's frame
            ]
        )

    @property
    def speed(self) -> float:
        """Speed of the rear axle."""
        return float(self.state[3])

    @property
    def body_to_world(self) -> np.ndarray:
        """Pose (4, 4) of the body, with its pitch and roll."""
        self._require_reset()
        matrix = np.eye(4)
        matrix[:3, :3] = self._rotation()
        matrix[:3, 3] = self._data.joint(mjcf_car.BODY).qpos[:3]
        matrix[:3, 3] += self.reference * matrix[:3, 0]
        matrix[2, 3] -= self._settled[2]
        return matrix

    @property
    def slip_speeds(self) -> np.ndarray:
        """Sideways speeds (2,) of front and rear axle over the ground, m/s."""
        rotation, body = self._rotation(), self._data.joint(mjcf_car.BODY)
        rear = float(body.qvel[:3] @ rotation[:, 1])
        along, rate = float(body.qvel[:3] @ rotation[:, 0]), self.state[5]
        steer = self.state[4]
        front = rear + self.car.wheelbase * rate
        return np.array([front * math.cos(steer) - along * math.sin(steer), rear])

    def _substep(self, angle: float, speed: float, change: float) -> None:
        """Command steering and motor, and integrate one timestep.

        Args:
            angle: of the front wheels, wanted.
            speed: to hold.
            change: of this speed within the timestep, m/s.
        """
        model, data = self._model, self._data
        dt = model.opt.timestep
        reach = self.handling.steer_rate * dt
        self._steer += min(max(angle - self._steer, -reach), reach)
        missing = speed - self.car.wheel_radius * data.ten_velocity[0]
        low, high = self._force
        acceleration = _SPEED_GAIN * missing + _SPEED_INTEGRAL_GAIN * self._excess
        acceleration += change / dt
        if low < acceleration < high:  # the integral does not wind up at the limit
            self._excess += missing * dt
        data.ctrl[:] = self._steer, min(max(acceleration, low), high)
        mujoco.mj_step(model, data)

    def _settle(self) -> np.ndarray:
        """Return the positions (nq,) at rest on the tyres."""
        for _ in range(round(_SETTLE_S / self._model.opt.timestep)):
            mujoco.mj_step(self._model, self._data)
        settled = self._data.qpos.copy()
        settled[3:7] = 1, 0, 0, 0
        settled[7:] = 0
        return settled

    def _rotation(self) -> np.ndarray:
        flat = np.empty(9)
        mujoco.mju_quat2Mat(flat, self._data.joint(mjcf_car.BODY).qpos[3:])
        return flat.reshape(3, 3)

    def _heading(self) -> float:
        forward = self._rotation()[:, 0]
        return math.atan2(forward[1], forward[0])

    def _require_reset(self) -> None:
        if self._speed is None:
            raise InputError("vehicle: it has a state only after reset")


def _count_substeps(period: float, timestep: float) -> int:
    if not 0 < timestep <= mjcf_car.MAX_TIMESTEP:
        raise InputError(
            f"timestep: {timestep!r} s; above 0 and at most {mjcf_car.MAX_TIMESTEP}"
        )
    if not 0 < period < float("inf"):
        raise InputError(f"period: {period!r} s; a positive number")
    count = round(period / timestep)
    if count < 1 or abs(count * timestep - period) > 1e-6 * period:
        raise InputError(
            f"period: {period!r} s is no multiple of the physics timestep {timestep!r} "
            "s; give another of the two"
        )
    return count
