"""Single-track models whose speed is a state: with rolling wheels, or with tyre slip.

Both take two controls, the steering angle of the front wheels (rad) and an acceleration
along the car (m/s^2), negative to brake. Neither drives backwards: brakes fade to
nothing as the car stops, see `longitudinal`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from mi_nerfattack.ranges import Acute, Positive, checked
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, soft_limit

#: Acceleration from which on a standing car moves off as commanded, m/s^2. Below, the
#: command fades as brakes do, so that the model has no kink between both.
MOVE_OFF = 0.1
GRAVITY = 9.81  # m/s^2


def longitudinal(speed: Any, acceleration: Any, stop_speed: float) -> Any:
    """Return the acceleration dv/dt that a command has at a speed.

    A command above `MOVE_OFF` is followed as it is. A negative one is multiplied by
    `tanh(v / stop_speed)`: at three times the stop speed a car brakes with 99.5 % of
    it, and a car at rest stays there. Between both a smooth step leads from one to the
    other. All of it has a continuous derivative.

    Args:
        speed: v (n,), m/s.
        acceleration: (n,), m/s^2, limited.
        stop_speed: m/s.

    Returns:
        (n,), m/s^2.
    """
    step = dr.clip(acceleration / MOVE_OFF, 0, 1)
    share = step * step * (3 - 2 * step)
    return acceleration * (share + (1 - share) * dr.tanh(speed / stop_speed))


@dataclass(frozen=True)
class AbstractSingleTrack(AbstractDynamics):
    """What both models have: their two controls, and the limits of these.

    Args:
        speed: v of the first state, m/s.
        max_steer: limit of the steering angle, radians, below pi/2.
        max_acceleration: largest acceleration, m/s^2.
        max_brake: largest deceleration, m/s^2.
        stop_speed: below about three times this, brakes fade, m/s. A time step of more
            than ``2 stop_speed / max_brake`` makes the car swing about rest.
    """

    speed: Positive = 5.0
    max_steer: Acute = 0.6
    max_acceleration: Positive = 3.0
    max_brake: Positive = 8.0
    stop_speed: Positive = 0.5

    control_names: ClassVar[tuple[str, ...]] = ("steering", "acceleration")

    def speed_of(self, state: Any) -> Any:
        """Return the row v (n,)."""
        return state[3]

    def extend(self, poses: np.ndarray) -> np.ndarray:
        """Append the first speed, and zeros: (n, 3) to (n, m)."""
        states = super().extend(poses)
        states[:, 3] = self.speed
        return states

    def saturate(self, control: Any) -> Any:
        """Limit both rows of (2, n) with `soft_limit`, brakes by a separate limit."""
        steering, acceleration = control
        limit = dr.select(acceleration < 0, self.max_brake, self.max_acceleration)
        return type(control)(
            soft_limit(steering, self.max_steer), soft_limit(acceleration, limit)
        )


@dataclass(frozen=True)
@checked("KinematicSingleTrack")
class KinematicSingleTrack(AbstractSingleTrack):
    """Car whose wheels roll without slip, seen from the middle of its rear axle.

    State (px, py, theta, v). `dx/dt = (v cos theta, v sin theta, v/l tan u, a)` with
    the steering angle u and `a` of `longitudinal`. Source: Kong et al. 2015, section
    II, for the rear axle; "KS" of Althoff et al. 2017.

    Args:
        wheelbase: l, metres.
    """

    wheelbase: Positive = 2.7

    @property
    def state_size(self) -> int:
        """4: px, py, theta, v."""
        return 4

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (4, n) from state (4, n) and controls (2, n), rad and m/s^2."""
        steering, acceleration = control
        sin, cos = dr.sincos(state[2])
        speed = state[3]
        return type(state)(
            cos * speed,
            sin * speed,
            speed / self.wheelbase * dr.tan(steering),
            longitudinal(speed, acceleration, self.stop_speed),
        )


@dataclass(frozen=True)
@checked("DynamicSingleTrack")
class DynamicSingleTrack(AbstractSingleTrack):
    """Car whose tyres slip, seen from its centre of gravity.

    State (px, py, theta, v, w, r): v and w are the speeds along the car and to its
    left (m/s), r is the heading rate (rad/s). With the lateral forces F of the axles
    and the steering angle u,

    - `dv/dt = a + w r - F_front sin(u) / m`,
    - `dw/dt = (F_front cos(u) + F_rear) / m - v r`,
    - `dr/dt = (f F_front cos(u) - b F_rear) / I`.

    An axle that rolls with the speed p along its wheels and q to their left has the
    slip angle `alpha = atan(-q / hypot(p, low_speed))` and the force
    `mu N s / sqrt(1 + s^2)` with `s = C alpha / (mu N)` and the load N at rest. That
    is the Magic Formula with the shape factor 1: `C alpha` for small angles, and never
    more than `mu N`. `low_speed` keeps the equations from becoming stiff as the car
    stops; there the wheels roll without slip.

    The fastest motion decays with about ``(C_front + C_rear) / (m low_speed)`` per
    second; explicit methods need time steps of at most 2.7 (RK4) or 2 (Euler) over it.

    Left out: load transfer, the share of friction that acceleration and brakes take,
    and rolling resistance. Source: Rajamani 2012, sections 2.3 and 13; "ST" of Althoff
    et al. 2017.

    Args:
        front_m: f, distance from the centre of gravity to the front axle, metres.
        rear_m: b, the same to the rear axle.
        mass: m, kilograms.
        yaw_inertia: I, kg m^2, about the vertical.
        front_stiffness: C of the front axle, newtons per radian.
        rear_stiffness: C of the rear axle.
        friction: mu, coefficient of tyre and road.
        low_speed: metres per second.
    """

    front_m: Positive = 1.35
    rear_m: Positive = 1.35
    mass: Positive = 1400.0
    yaw_inertia: Positive = 2200.0
    front_stiffness: Positive = 80000.0
    rear_stiffness: Positive = 80000.0
    friction: Positive = 0.9
    low_speed: Positive = 1.0

    @property
    def state_size(self) -> int:
        """6: px, py, theta, v, w, r."""
        return 6

    @property
    def fastest_rate(self) -> float:
        """Largest rate of decay of the model at rest, 1/s."""
        stiffness = np.array([self.front_stiffness, self.rear_stiffness])
        arms = np.array([self.front_m, -self.rear_m])
        # The tyres' slip at v = 0, linearised: d(w, r)/dt = -matrix (w, r) / low_speed
        sideways, mixed = stiffness.sum() / self.mass, stiffness @ arms
        turning = stiffness @ arms**2 / self.yaw_inertia
        matrix = [[sideways, mixed / self.mass], [mixed / self.yaw_inertia, turning]]
        slip = float(np.abs(np.linalg.eigvals(matrix)).max()) / self.low_speed
        return max(slip, self.max_brake / self.stop_speed)

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (6, n) from state (6, n) and controls (2, n), rad and m/s^2."""
        steering, acceleration = control
        along, left, rate = state[3], state[4], state[5]
        sin, cos = dr.sincos(state[2])
        sin_u, cos_u = dr.sincos(steering)
        # speeds of the front axle, in the frame of its wheels
        ahead = left + self.front_m * rate
        rolling, sliding = along * cos_u + ahead * sin_u, ahead * cos_u - along * sin_u
        # loads of the axles at rest, and the lateral forces of their tyres
        length = self.front_m + self.rear_m
        load = self.mass * GRAVITY / length
        front = self._force(
            rolling, sliding, self.front_stiffness, load=load * self.rear_m
        )
        rear = self._force(
            along,
            left - self.rear_m * rate,
            self.rear_stiffness,
            load=load * self.front_m,
        )
        # accelerations along the car, to its left and about the vertical
        driven = longitudinal(along, acceleration, self.stop_speed)
        moment = self.front_m * front * cos_u - self.rear_m * rear
        return type(state)(
            cos * along - sin * left,
            sin * along + cos * left,
            rate,
            driven + left * rate - front * sin_u / self.mass,
            (front * cos_u + rear) / self.mass - along * rate,
            moment / self.yaw_inertia,
        )

    def _force(self, rolling: Any, sliding: Any, stiffness: float, load: float) -> Any:
        """Return the force (n,) of an axle to its left, newtons."""
        reach = dr.sqrt(dr.square(rolling) + self.low_speed**2)
        most = self.friction * load
        slip = -stiffness / most * dr.atan(sliding / reach)
        return most * slip / dr.sqrt(1 + dr.square(slip))
