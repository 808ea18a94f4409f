"""What ends a drive, by name, and the rounds of the loop."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

from mi_nerfattack.car.devices import (
    AbstractTracker,
    Clock,
    Decision,
    DeviceLostError,
    Frame,
    MotorValues,
    TrackedPose,
)
from mi_nerfattack.car.drive.safety.fence import Fence, car_corners
from mi_nerfattack.deploy.car import Car
from mi_nerfattack.ranges import NonNegative, Positive, Seconds, checked

_T = TypeVar("_T")
_AHEAD_S = 0.05  # that a device's time may be ahead of ours before its clock is wrong
_ANSWER_S = 0.1  # in which the motor's values follow the first command


class Cause(Enum):
    """Why a drive ended; the value is what logs and messages call it."""

    RELEASED = "enable released"
    FRAME_OLD = "frame old"
    POSE_OLD = "pose old"
    OUTSIDE = "outside the fence"
    NOT_FINITE = "control not finite"
    OUT_OF_RANGE = "control out of range"
    DECISION_OLD = "decision of an old frame"
    CAMERA_LOST = "camera lost"
    TRACKER_LOST = "tracker lost"
    MOTOR_LOST = "motor lost"
    PILOT_LOST = "pilot lost"
    MOTOR_FAULT = "motor fault"
    MOTOR_KILLED = "kill switch"
    MOTOR_TIMED_OUT = "motor controller timed out"
    MOTOR_FED = "motor controller fed by another"
    MOTOR_HOT = "motor controller hot"
    BATTERY_LOW = "battery low"
    TOO_FAST = "too fast"
    SPEEDS_DIFFER = "speeds of tracker and motor differ"
    LOOP_LATE = "loop late"
    LOG_FAILED = "log not written"
    EXCEPTION = "exception"
    INTERRUPTED = "interrupted"
    TIME_UP = "time is up"

    @property
    def is_planned(self) -> bool:
        """Whether the person who drives wanted it so."""
        return self in (Cause.RELEASED, Cause.TIME_UP)


class Stop(Exception):
    """Ends a drive.

    Args:
        cause: by name.
        message: what was found, for a person.
    """

    def __init__(self, cause: Cause, message: str) -> None:
        super().__init__(f"{cause.value}: {message}")
        self.cause, self.message = cause, message


def asked(cause: Cause, call: Callable[[], _T]) -> _T:
    """Ask a device.

    Raises:
        Stop: of this cause, the device is lost.
    """
    try:
        return call()
    except DeviceLostError as error:
        raise Stop(cause, str(error)) from error


@dataclass(frozen=True)
@checked("ages")
class Ages:
    """How old what the car drives by may be, seconds.

    Args:
        frame_s: the camera's newest frame; and that of a decision when it is sent,
            which may be a control period older until the next one comes.
        pose_s: the tracker's newest pose.
        loop_s: since the control loop last came round.
    """

    frame_s: Seconds = 0.15
    pose_s: Seconds = 0.10
    loop_s: Seconds = 0.20


@dataclass(frozen=True)
@checked("judge")
class Judge:
    """Looks at what devices say, and ends the drive by raising `Stop`.

    Args:
        ages: largest ones.
        fence: where the car's outline must stay.
        car: its outline.
        max_control: size of a control, in the policy's unit, beyond which it is taken
            for nonsense; up to there, the limits cut it.
        period_s: of control.
        battery_least_v: below which it counts as empty.
        fet_most_c: temperature of the motor controller's MOSFETs.
    """

    ages: Ages
    fence: Fence
    car: Car
    max_control: Positive
    period_s: Seconds
    battery_least_v: NonNegative = 0.0
    fet_most_c: Positive = 80.0

    def frame(self, frame: Frame | None, now_s: float) -> None:
        """Judge the camera's newest frame."""
        time = None if frame is None else frame.time_s
        _check_age(
            Cause.FRAME_OLD,
            "the newest frame",
            time,
            now_s=now_s,
            limit_s=self.ages.frame_s,
        )

    def pose(
        self,
        pose: TrackedPose | None,
        now_s: float,
        tracker: AbstractTracker,
        body: str,
    ) -> None:
        """Judge the newest pose, and where it is."""
        limit = self.ages.pose_s
        if pose is None or not _is_fresh(now_s - pose.time_s, limit):
            age = "none came" if pose is None else _age_text(now_s - pose.time_s, limit)
            raise Stop(
                Cause.POSE_OLD, f"the newest pose: {age}; {tracker.explain(body)}"
            )
        x, y = pose.body_to_world[:2, 3]
        corners = car_corners(self.car, pose.body_to_world)
        if not self.fence.encloses(corners):
            raise Stop(Cause.OUTSIDE, f"the car is at x {x:.2f} m, y {y:.2f} m")

    def motor(
        self, values: MotorValues | None, first_command_s: float | None = None
    ) -> None:
        """Judge what the motor controller says.

        Args:
            values: newest ones; None where it has said nothing.
            first_command_s: before which it rightly brakes, since nobody commands it.
        """
        if values is None:
            raise Stop(Cause.MOTOR_LOST, "it has said nothing")
        if values.fault:
            message = f"{values.fault_name} (number {values.fault})"
            raise Stop(Cause.MOTOR_FAULT, message)
        if values.is_killed:
            raise Stop(Cause.MOTOR_KILLED, "that of the motor controller is pressed")
        if (volts := values.input_voltage_v) is not None:
            if volts < self.battery_least_v:
                message = f"{volts:.1f} V, at least {self.battery_least_v:g} V"
                raise Stop(Cause.BATTERY_LOW, message)
        if (celsius := values.fet_temperature_c) is not None:
            if celsius > self.fet_most_c:
                message = f"{celsius:.0f} degrees C, at most {self.fet_most_c:g}"
                raise Stop(Cause.MOTOR_HOT, message)
        if first_command_s is None:
            if values.has_timed_out is False:
                raise Stop(
                    Cause.MOTOR_FED,
                    "nothing is sent, but its timeout does not fire; if this stays, "
                    "end VESC Tool, its app and what else commands it",
                )
        elif values.has_timed_out and values.time_s > first_command_s + _ANSWER_S:
            raise Stop(Cause.MOTOR_TIMED_OUT, "it brakes, for no command reached it")

    def decision(self, decision: Decision | None, now_s: float, is_new: bool) -> None:
        """Judge the newest decision.

        Args:
            decision: newest one.
            now_s: the time.
            is_new: whether it is about to be sent; else it was before.
        """
        limit = self.ages.frame_s + (0.0 if is_new else self.period_s)
        time = None if decision is None else decision.frame_time_s
        _check_age(
            Cause.DECISION_OLD,
            "the frame of the decision",
            time,
            now_s=now_s,
            limit_s=limit,
        )
        assert decision is not None
        if not math.isfinite(decision.control):
            raise Stop(Cause.NOT_FINITE, f"the policy gave {decision.control}")
        if abs(decision.control) > self.max_control:
            raise Stop(
                Cause.OUT_OF_RANGE,
                f"the policy gave {decision.control:.3g}; at most {self.max_control:g}",
            )


def _check_age(
    cause: Cause, what: str, time_s: float | None, now_s: float, limit_s: float
) -> None:
    if time_s is None:
        raise Stop(cause, f"{what}: none came")
    if not _is_fresh(now_s - time_s, limit_s):
        raise Stop(cause, f"{what}: {_age_text(now_s - time_s, limit_s)}")


def _is_fresh(age_s: float, limit_s: float) -> bool:
    return -_AHEAD_S <= age_s <= limit_s  # not of NaN


def _age_text(age_s: float, limit_s: float) -> str:
    if age_s < 0:
        return f"its time is {-age_s:.3f} s ahead; the clocks differ"
    return f"{age_s:.3f} s old, at most {limit_s:g} s"


def suspended_clock() -> float:
    """Return seconds that go on while the computer is suspended, as by a closed lid.

    `time.monotonic` stands still meanwhile on Linux: what was measured before would
    look as if it had just come.
    """
    if sys.platform == "linux":
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


class Rounds:
    """Refuses commands after a round that took too long.

    While a round takes long, the motor controller brakes by its own timeout.

    Args:
        limit_s: longest round.
        clock: see `suspended_clock`.

    Attributes:
        limit_s: as given.
    """

    def __init__(self, limit_s: float, clock: Clock) -> None:
        self.limit_s, self._clock, self._begun_s = limit_s, clock, clock()

    def begin(self) -> float:
        """Begin a round; return seconds since the last one began."""
        before, self._begun_s = self._begun_s, self._clock()
        return self._begun_s - before

    def check(self) -> float:
        """Return seconds since the round began.

        Raises:
            Stop: these are too many.
        """
        took_s = self._clock() - self._begun_s
        if took_s > self.limit_s:
            raise Stop(
                Cause.LOOP_LATE, f"took {took_s:.3f} s, at most {self.limit_s:g} s"
            )
        return took_s
