"""Experts, which know the true state: the interface, and followers of the lane."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mi_nerfattack.ranges import Acute, Negative, Positive, checked
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.steering import heading_rate, steering_angle


class AbstractExpert(ABC):
    """Controller of vehicles on a route by their present states alone.

    Attributes:
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
    """

    control_unit: ClassVar[str]

    @abstractmethod
    def control(self, states: Any) -> np.ndarray:
        """Compute the controls of the next period.

        Args:
            states: (n, m) or (m,), m >= 3: x, y (metres), heading (radians), others
                that are not read.

        Returns:
            (n,), positive to the left, clipped to the expert's limit; (n, 2) of a
            `SpeedKeeper`.
        """


@dataclass(frozen=True, eq=False)
@checked("LaneFollower")
class LaneFollower(AbstractExpert):
    """Feed-forward of the route's curvature with feedback of both errors.

    Heading rate `v (kappa - e / d^2 - 2 sin(psi) / d)` for cross-track error e,
    heading error psi and look-ahead distance d. Linearised, deviations decay as
    `(1 + s/d) exp(-s/d)` over the arc length s: critically damped, which wheels that
    answer late turn into a little overshoot. The feed-forward does not cut corners,
    which allows gains low enough to be imitated.

    Args:
        route: lane centre to follow.
        speed: v, metres per second; the route's nominal speed unless given.
        look_ahead_m: d, metres. Longer is smoother and slower to recover.
        preview_m: arc length ahead of the vehicle at which the curvature is read,
            metres; half of what it travels during one step, and what it travels
            until its wheels have answered.
        heading_preview_m: the same for the heading: 0 for an accurate integrator,
            half a step for explicit Euler, which moves along the chord.
        max_heading_rate: limit of the result, radians per second.
        window_m: arc length over which the polyline's curvature is averaged, metres.
    """

    route: Route
    speed: Positive | None = None
    look_ahead_m: Positive = 2.75
    preview_m: float = 0.25
    heading_preview_m: float = 0.0
    max_heading_rate: Positive = 1.5
    window_m: Positive = 1.0

    control_unit: ClassVar[str] = "rad/s"

    def __post_init__(self) -> None:
        if self.speed is None:
            object.__setattr__(self, "speed", float(self.route.speed_ms))

    def control(self, states: Any) -> np.ndarray:
        """Compute the heading rate of a Dubins vehicle.

        Args:
            states: (n, m) or (m,), metres and radians.

        Returns:
            (n,), radians per second, positive to the left, clipped to the limit.
        """
        states = np.atleast_2d(np.asarray(states, np.float64))
        arc, cross_track, _ = self.route.project_numpy(states)
        heading = self.route.heading_at(arc + self.heading_preview_m)
        curvature = self.route.curvature_at(arc + self.preview_m, self.window_m)
        feedback = 2 / self.look_ahead_m * np.sin(states[:, 2] - heading)
        feedback += cross_track / self.look_ahead_m**2
        rate = float(self.speed or 0) * (curvature - feedback)
        return np.clip(rate, -self.max_heading_rate, self.max_heading_rate)


@dataclass(frozen=True, eq=False)
@checked("SteeringFollower")
class SteeringFollower(AbstractExpert):
    """Lane follower of a car: the steering angle `atan(l w / v)` of a heading rate w.

    Args:
        follower: gives the heading rate; its limit applies as well.
        wheelbase: l, metres.
        max_control: limit of the steering angle, radians, below pi/2.
    """

    follower: LaneFollower
    wheelbase: Positive = 2.7
    max_control: Acute = 0.6

    control_unit: ClassVar[str] = "rad"

    def control(self, states: Any) -> np.ndarray:
        """Compute steering angles (n,), radians, of states (n, m) or (m,)."""
        rate = self.follower.control(states)
        angle = steering_angle(rate, float(self.follower.speed or 0), self.wheelbase)
        return np.clip(angle, -self.max_control, self.max_control)


@dataclass(frozen=True, eq=False)
@checked("SpeedKeeper")
class SpeedKeeper(AbstractExpert):
    """A follower of the lane for a vehicle whose second control is an acceleration.

    The acceleration is `gain (v - speed)`, clipped. The follower steers as at the speed
    v, whatever the speed is: the angle decides about the curvature alone.

    Args:
        follower: steers.
        speed: v, wanted, m/s.
        lowest: acceleration, m/s^2, of the brakes.
        highest: largest acceleration, m/s^2.
        gain: 1/s.
    """

    follower: SteeringFollower
    speed: Positive
    lowest: Negative = -8.0
    highest: Positive = 3.0
    gain: Positive = 1.0

    control_unit: ClassVar[str] = "rad"

    def control(self, states: Any) -> np.ndarray:
        """Compute both controls (n, 2) of states (n, m) or (m,).

        Row 3 of a state is its speed, m/s; a state without it has the wanted one.
        """
        states = np.atleast_2d(np.asarray(states, np.float64))
        has_speed = states.shape[1] > 3
        missing = self.speed - (states[:, 3] if has_speed else self.speed)
        acceleration = np.clip(self.gain * missing, self.lowest, self.highest)
        steering = self.follower.control(states)
        return np.stack([steering, np.broadcast_to(acceleration, len(states))], axis=1)


def future_positions(
    expert: AbstractExpert,
    poses: np.ndarray,
    times: Sequence[float],
    *,
    speed: float,
    period: float,
    wheelbase: float,
) -> np.ndarray:
    """Drive with an expert from several poses, and return the future positions.

    The vehicle is kinematic: its speed is constant, its wheels answer at once, and it
    holds the control of each period. So it moves along arcs, which are exact here.

    Args:
        expert: gives the control at the start of each period.
        poses: (n, 3), x and y in metres, heading in radians; may be outside the lane.
        times: k times ahead, seconds, at least 0.
        speed: metres per second.
        period: seconds that a control is held.
        wheelbase: metres, of an expert that gives steering angles.

    Returns:
        (n, k, 2), metres forward and to the left of each pose.
    """
    ahead = np.asarray(times, np.float64)
    full_periods = np.floor(ahead / period + 1e-6)  # periods before the last one
    start = np.asarray(poses, np.float64)[:, :3]
    state, world = start, np.empty((len(start), len(ahead), 2))
    for step in range(int(full_periods.max()) + 1):
        rate = expert.control(state).reshape(len(state), -1)[:, 0]
        if expert.control_unit == "rad":
            rate = heading_rate(rate, speed, wheelbase)
        for index in np.flatnonzero(full_periods == step):
            seconds = max(0.0, ahead[index] - step * period)
            world[:, index] = _along_arc(state, rate, speed, seconds=seconds)[:, :2]
        state = _along_arc(state, rate, speed, seconds=period)
    offset, heading = world - start[:, None, :2], start[:, 2:]
    dx, dy = offset[..., 0], offset[..., 1]
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)


def _along_arc(
    states: np.ndarray, rate: np.ndarray, speed: float, seconds: float
) -> np.ndarray:
    """Move states (n, 3) at heading rates (n,), rad/s, and a speed in m/s."""
    turn = rate * seconds
    chord = speed * seconds * np.sinc(turn / (2 * np.pi))
    middle = states[:, 2] + turn / 2
    step = [chord * np.cos(middle), chord * np.sin(middle), turn]
    return states + np.stack(step, axis=-1)
