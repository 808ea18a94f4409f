"""What a command may be at most, whatever a policy asks for; applied last."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mi_nerfattack.car.devices import Command
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Acute, ControlUnit, Positive, checked
from mi_nerfattack.vehicle.steering import steering_angle

_SLOWEST_MS = 0.2  # below it no angle turns a car as fast as a policy asks


@dataclass(frozen=True)
@checked("limits")
class Limits:
    """Bounds of speed and steering angle, and of how fast either may change.

    Args:
        speed_ms: metres per second; never backwards.
        steering_rad: to either side.
        acceleration_ms2: of the speed that is asked for, up and down.
        steering_rate: of the angle that is asked for, radians per second.
    """

    speed_ms: Positive
    steering_rad: Acute
    acceleration_ms2: Positive
    steering_rate: Positive

    def apply(self, request: Command, before: Command, elapsed_s: float) -> Command:
        """Return the command nearest to the wanted one that may be sent.

        Args:
            request: by the policy and the speed set.
            before: what was sent last.
            elapsed_s: since then.

        Raises:
            InputError: a number is not finite.
        """
        if not (
            math.isfinite(request.speed_ms) and math.isfinite(request.steering_rad)
        ):
            raise InputError(f"command: {request}; must be finite")
        speed = min(max(request.speed_ms, 0.0), self.speed_ms)
        side = math.copysign(self.steering_rad, request.steering_rad)
        angle = min(request.steering_rad, side, key=abs)
        return Command(
            _towards(before.speed_ms, speed, self.acceleration_ms2 * elapsed_s),
            _towards(before.steering_rad, angle, self.steering_rate * elapsed_s),
        )


@dataclass(frozen=True)
@checked("steering")
class Steering:
    """From a policy's control to the angle of the front wheels.

    Args:
        control_unit: "rad" of a steering angle, or "rad/s" of a heading rate.
        wheelbase: l, metres.
    """

    control_unit: ControlUnit = "rad"
    wheelbase: Positive = 0.325

    def angle(self, control: float, speed_ms: float) -> float:
        """Return the angle: the control itself, or `atan(l w / v)` of a rate w.

        Args:
            control: in its unit.
            speed_ms: v, of the car at this moment; of less than 0.2, 0.2.
        """
        if self.control_unit == "rad":
            return control
        speed_ms = max(speed_ms, _SLOWEST_MS)
        return float(steering_angle(control, speed_ms, self.wheelbase))


def _towards(value: float, goal: float, step: float) -> float:
    return min(max(goal, value - step), value + step)
