"""Calibration of a car by short drives, each measured on the floor afterwards.

A drive with the servo held is an arc. You measure how far the arc ends ahead and to the
left of its start; this gives its length and its curvature. The motor's steps divided by
the length are the scale of speed. The servo's position is a line in the steering angle
of the arcs. Its slope is the scale of steering, and its value at a steering angle of 0
is the centre.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mi_nerfattack.car.devices import Command
from mi_nerfattack.car.drive.safety.judge import suspended_clock
from mi_nerfattack.car.vesc.calibration import Calibration
from mi_nerfattack.car.vesc.motor import VescMotor
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.vehicle.steering import steering_angle

_PERIOD_S = 0.05
_FED_S = 0.3  # after the timeout, until somebody else must feed it
_STANDING_MS, _STOP_S = 0.02, 5.0
_STILL_S, _UNCOUNTED_M = 0.5, 0.2  # of a motor that stands, of one that is not counted
# Steps of the tachometer: six to an electrical turn, of which ERPM counts a minute's.
_ERPM_PER_STEP = 60 / 6
Drive = Literal["straight", "to the left", "to the right"]
#: Drives of a calibration, and the sign of their steering.
DRIVES: Mapping[Drive, int] = {"straight": 0, "to the left": 1, "to the right": -1}


@dataclass(frozen=True)
class Arc:
    """A drive with the servo held.

    Args:
        servo: its position, 0 to 1.
        steps: of the motor's tachometer, from standstill to standstill.
        forward_m, left_m: where the middle of the rear axle came to, seen from where
            it was, metres.
    """

    servo: float
    steps: int
    forward_m: float
    left_m: float

    @property
    def length_m(self) -> float:
        """Way of the middle of the rear axle, metres."""
        half_turn = math.atan2(self.left_m, self.forward_m)
        chord = math.hypot(self.forward_m, self.left_m)
        return float(chord / np.sinc(half_turn / np.pi))

    @property
    def curvature(self) -> float:
        """Of that way, 1/m, positive to the left."""
        return 2 * self.left_m / (self.forward_m**2 + self.left_m**2)

    def check(self) -> None:
        """Check that the arc is long enough to calibrate with.

        Raises:
            InputError: the arc is too short, or the motor did not turn.
        """
        if not self.length_m > 0.1 or not self.steps:
            raise InputError(
                f"VESC: {self.forward_m:g} m forward and {self.left_m:g} m left in "
                f"{self.steps} steps of the motor; drive farther"
            )


def drive_arc(
    motor: VescMotor,
    command: Command,
    distance_m: float,
    check: Callable[[], None],
) -> tuple[float, int]:
    """Drive until the motor has turned for a distance, and brake to a standstill.

    Args:
        motor: armed; its own calibration says what the command and distance are to it.
        command: held all the way.
        distance_m: metres.
        check: called before each command; what it raises brakes.

    Returns:
        The servo's position, and the steps of the tachometer.

    Raises:
        InputError: the car does not get that far in time or does not stop. Also where
            the motor is not measured or has a fault, or its kill switch is pressed.
        DeviceLostError: the controller is lost, or has restarted.
    """
    calibration = motor.calibration
    target_steps = distance_m * calibration.erpm_per_ms / _ERPM_PER_STEP
    motor.check()
    _require_silence(motor)
    start = _steps(motor)
    watch = _Watch(motor.calibration, command.speed_ms, distance_m)
    check()
    try:
        sent = motor.send(command)
        while (steps := abs(_steps(motor) - start)) < target_steps:
            check()
            watch.check(steps, motor.values.erpm or 0)
            sent = motor.send(command)
            time.sleep(_PERIOD_S)
    finally:
        motor.brake()
    _stop(motor)
    servo = calibration.servo_centre + calibration.servo_per_rad * sent.steering_rad
    return servo, abs(_steps(motor) - start)


def _require_silence(motor: VescMotor) -> None:
    """Raise `InputError` if the timeout does not fire: somebody else feeds it."""
    end = time.monotonic() + motor.calibration.timeout_ms / 1000 + _FED_S
    while not motor.values.has_timed_out:
        _steps(motor)
        if time.monotonic() > end:
            raise InputError(
                "VESC: nothing is sent, but its timeout does not fire: another program "
                "feeds it; end VESC Tool, its app, and what else commands it"
            )


def room_m(distance_m: float, speed_ms: float) -> float:
    """Return how far a car may come in a drive, its brake included, metres.

    By a scale of speed that is right: the motor's counters may fail.
    """
    return _longest_m(distance_m, speed_ms) + speed_ms * 1.0


def _longest_m(distance_m: float, speed_ms: float) -> float:
    """Return the way in the time that a drive may take."""
    return distance_m + max(0.5 * distance_m, speed_ms * 1.0)


class _Watch:
    """Ends a drive whose motor does not turn, or is not counted, or takes too long.

    Args:
        calibration: of the car.
        speed_ms: commanded.
        distance_m: of the drive.
    """

    def __init__(
        self, calibration: Calibration, speed_ms: float, distance_m: float
    ) -> None:
        self._calibration, self._distance_m = calibration, distance_m
        self._speed_ms, self._turned_m = speed_ms, 0.0
        self._begun_s = self._last_s = self._turning_s = suspended_clock()

    def check(self, steps: int, erpm: int) -> None:
        """Raise `InputError` unless all is well, by the tachometer and the ERPM."""
        now_s, scale = suspended_clock(), self._calibration.erpm_per_ms
        passed_s, self._last_s = now_s - self._last_s, now_s
        if passed_s > self._calibration.timeout_ms / 1000:
            raise InputError(
                f"VESC: this computer stood still for {passed_s:.2f} s, in which the "
                "controller braked; end other programs, and begin again"
            )
        self._turned_m += abs(erpm) / scale * passed_s
        if abs(erpm) > _STANDING_MS * scale:
            self._turning_s = now_s
        elif now_s > self._turning_s + _STILL_S:
            raise InputError(
                f"VESC: its motor does not turn, or is not measured: {erpm} ERPM for "
                f"{_STILL_S:g} s; check motor, hall sensors and wheels"
            )
        counted_m = steps * _ERPM_PER_STEP / scale
        if self._turned_m > 1.5 * counted_m + _UNCOUNTED_M:
            raise InputError(
                f"VESC: its tachometer says {counted_m:.2f} m, its ERPM "
                f"{self._turned_m:.2f} m; check motor and hall sensors"
            )
        longest_m = _longest_m(self._distance_m, self._speed_ms)
        if (now_s - self._begun_s) * self._speed_ms > longest_m:
            raise InputError(
                f"VESC: {counted_m:.2f} of {self._distance_m:g} m after the time for "
                f"{longest_m:g} m; drive faster, check wheels and motor"
            )


def fit_arcs(
    arcs: Sequence[Arc], wheelbase_m: float, calibration: Calibration
) -> tuple[Calibration, float, float]:
    """Return the calibration that arcs tell, and how far they are from it.

    Args:
        arcs: two or more, with different positions of the servo.
        wheelbase_m: of the car, metres.
        calibration: what they do not tell is its.

    Returns:
        The calibration; the largest distance of a steering angle from its line,
        radians; the largest relative difference of the arcs' scales of speed.

    Raises:
        InputError: what they tell is not plausible.
    """
    for arc in arcs:
        arc.check()
    scales = [_ERPM_PER_STEP * arc.steps / arc.length_m for arc in arcs]
    servo = np.array([arc.servo for arc in arcs])
    curvature = np.array([arc.curvature for arc in arcs])
    steering = steering_angle(curvature, 1.0, wheelbase_m)
    if np.ptp(steering) < 0.05:
        raise InputError(
            f"VESC: steering angles of {steering.min():.3f} to {steering.max():.3f} "
            "rad tell no scale; does the servo move? (VESC Tool: Enable Servo Output)"
        )
    slope, foot = np.polyfit(steering, servo, 1)
    away = np.abs((servo - foot) / slope - steering).max()
    mean = sum(arc.steps for arc in arcs) / sum(arc.length_m for arc in arcs)
    changes = {
        "erpm_per_ms": round(_ERPM_PER_STEP * mean, 1),
        "servo_per_rad": round(float(slope), 4),
        "servo_centre": round(float(foot), 4),
        "wheelbase_m": wheelbase_m,
    }
    return (
        calibration.changed(changes),
        float(away),
        (max(scales) - min(scales)) / min(scales),
    )


def read_arcs(path: Path) -> dict[Drive, Arc]:
    """Read arcs by their drives; none where there is no file.

    Raises:
        InputError: the file cannot be read, or an arc fails `Arc.check`.
    """
    if not path.exists():
        return {}
    arcs = read_section(str(path), dict[Drive, Arc], files.read_json(path), folder="")
    for name, arc in arcs.items():
        try:
            arc.check()
        except InputError as error:
            raise InputError(f"{path}: {name}: {error}") from error
    return arcs


def write_arcs(path: Path, arcs: Mapping[Drive, Arc]) -> None:
    """Write arcs.

    Raises:
        InputError: the file cannot be written.
    """
    files.write_json(path, {name: asdict(arc) for name, arc in arcs.items()})


def _steps(motor: VescMotor) -> int:
    """Return the tachometer, newly read."""
    asked = time.monotonic()
    while True:
        read = motor.read()
        if read is not None and read.time_s > asked:
            if read.fault or read.is_killed:
                reason = read.fault_name if read.fault else "its kill switch is pressed"
                raise InputError(f"VESC: {reason}; mend it, and begin again")
            return motor.values.tachometer or 0
        time.sleep(0.01)


def _stop(motor: VescMotor) -> None:
    end = time.monotonic() + _STOP_S
    while True:
        motor.brake()
        _steps(motor)
        values = motor.values
        if abs(values.erpm or 0) < _STANDING_MS * motor.calibration.erpm_per_ms:
            return
        if time.monotonic() > end:
            raise InputError(
                f"VESC: still at {values.erpm} ERPM {_STOP_S:g} s after the brake; "
                "raise brake_current_a"
            )
        time.sleep(_PERIOD_S)
