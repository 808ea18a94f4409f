"""The right expert for a route and a vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import (
    ControlUnit,
    Negative,
    NonNegative,
    Positive,
    Seconds,
    checked,
)
from mi_nerfattack.vehicle.expert.lane_follower import (
    AbstractExpert,
    LaneFollower,
    SpeedKeeper,
    SteeringFollower,
)
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.steering import heading_rate

__all__ = [
    "AbstractExpert",
    "LaneFollower",
    "SpeedKeeper",
    "SteeringFollower",
    "expert_for",
]

#: Time in which a vehicle passes the look-ahead distance, seconds. With less than half
#: a second, a car whose wheels answer late needs long to recover from large deviations.
LOOK_AHEAD_S = 0.55

#: Time in which it passes what the curvature is averaged over, seconds.
WINDOW_S = 0.2


@dataclass(frozen=True)
@checked("expert")
class _Vehicle:
    """What an expert is told of its vehicle; see `expert_for`."""

    control_unit: ControlUnit
    period: Seconds
    max_control: Positive
    wheelbase: Positive
    lag: NonNegative
    acceleration: tuple[Negative, Positive] | None


def expert_for(
    control_unit: ControlUnit,
    route: Route,
    period: float,
    max_control: float = 1.5,
    wheelbase: float = 2.7,
    lag: float = 0.1,
    acceleration: tuple[float, float] | None = None,
) -> AbstractExpert:
    """Make the expert of a route for a vehicle.

    `LaneFollower` gives a heading rate, `SteeringFollower` a steering angle, and
    `SpeedKeeper` an acceleration besides. Distances grow with the route's speed. None
    remembers anything.

    The lag only moves the point where the curvature is read. One policy for cars with
    and without lag cannot know which it drives: label its frames with the lag in
    between that is the default, which costs some centimetres in bends.

    Args:
        control_unit: "rad/s" or "rad", as of the environment.
        route: with the speed of the vehicle.
        period: seconds that a control is held.
        max_control: limit of the control, in its unit, as of the environment.
        wheelbase: of the car, metres; has no effect on heading rates.
        lag: seconds from a control to the vehicle's answer: 0 of kinematic models,
            otherwise its steering's time constants and delay.
        acceleration: lowest and highest acceleration, m/s^2, of a vehicle whose second
            control it is; None of one with a single control.

    Raises:
        InputError: unknown unit, or a number out of range.
    """
    _Vehicle(
        control_unit,
        period,
        max_control,
        wheelbase=wheelbase,
        lag=lag,
        acceleration=acceleration,
    )
    if control_unit == "rad" and max_control >= math.pi / 2:
        raise InputError(f"expert.max_control: {max_control!r} rad; below pi/2")
    speed = float(route.speed_ms)
    look_ahead = speed * LOOK_AHEAD_S
    preview, window = speed * (period / 2 + lag), speed * WINDOW_S

    def follower(limit: float) -> LaneFollower:
        return LaneFollower(route, speed, look_ahead, preview, 0.0, limit, window)

    if control_unit == "rad":
        fastest = heading_rate(max_control, speed, wheelbase)
        steering = SteeringFollower(follower(fastest), wheelbase, max_control)
        if acceleration is None:
            return steering
        return SpeedKeeper(steering, speed, *acceleration)
    if acceleration is not None:
        raise InputError(
            "expert.acceleration: is given with a heading rate; an expert accelerates "
            "vehicles that are steered by an angle, in rad"
        )
    return follower(max_control)
