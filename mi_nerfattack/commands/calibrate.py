"""``mi-nerfattack calibrate``: speed and steering of a car, by drives on the floor."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from mi_nerfattack.robot.vesc.calibration import Calibration
    from mi_nerfattack.robot.vesc.guided import Arc
    from mi_nerfattack.robot.vesc.motor import VescMotor


@dataclass(frozen=True)
class Calibrate:
    """Find the scales of a car's motor and steering servo, and write them to a file.

    Three short drives, straight, to the left and to the right, each of which you
    measure with a tape. It asks before anything moves; Ctrl-C brakes.
    """

    port: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PORT")]
    """Serial port of the VESC, such as /dev/ttyACM0."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File for the calibration (.toml); one that exists is not written over."""
    calibration: Path | None = None
    """File to begin with; by default the scales of a RACECAR/J."""
    wheelbase_m: float = 0.25
    """From the front to the rear axle, metres."""
    speed_ms: float = 0.5
    """Speed of the drives."""
    distance_m: float = 1.5
    """Length of each drive, by the calibration that it begins with."""
    steering_rad: float = 0.2
    """Steering of the drives that turn, by that calibration."""
    baudrate: int = 115_200
    """Of the port, if it is a UART."""

    def run(self) -> int:
        """Ask, arm, drive, ask, fit and write."""
        from mi_nerfattack.robot.vesc.calibration import (
            Calibration,
            read_calibration,
            write_calibration,
        )
        from mi_nerfattack.robot.vesc.guided import fit_arcs
        from mi_nerfattack.robot.vesc.motor import VescMotor

        self._check()
        before = Calibration()
        if self.calibration is not None:
            before = read_calibration(self.calibration)
        with closing(VescMotor(self.port, before, _confirm, self.baudrate)) as motor:
            print(f"{self.port}: firmware {motor.firmware}")
            _ask(
                "Lift the wheels off the ground: they turn for a second. Enter to go on"
            )
            motor.arm()
            print(
                f"Armed: without commands it brakes after {before.timeout_ms} ms with "
                f"{before.brake_current_a:g} A."
            )
            arcs = [
                self._measure(motor, name, sign * self.steering_rad)
                for name, sign in (
                    ("straight", 0),
                    ("to the left", 1),
                    ("to the right", -1),
                )
            ]
        found, away_rad, spread = fit_arcs(arcs, self.wheelbase_m, before)
        write_calibration(self.output, found)
        self._tell(before, found)
        print(
            f"Lengths agree to {spread:.1%}, steering angles to "
            f"{math.degrees(away_rad):.1f} degrees. Written to {self.output}."
        )
        return 0

    def _check(self) -> None:
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io import files

        for name in ("wheelbase_m", "speed_ms", "distance_m", "steering_rad"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise InputError(f"--{name.replace('_', '-')}: {value}; more than 0")
        if self.output.exists():
            raise InputError(f"{self.output}: exists; choose another file")
        files.check_writable(self.output)

    def _measure(self, motor: VescMotor, name: str, steering_rad: float) -> Arc:
        """Drive once, and ask how far it came."""
        from mi_nerfattack.robot.devices import Command
        from mi_nerfattack.robot.vesc.guided import Arc, drive_arc

        _ask(
            f"Drive {name}, about {self.distance_m:g} m at {self.speed_ms:g} m/s. Put "
            "the car on the floor with twice that free; mark where the middle of its "
            "rear axle stands, and the line straight ahead. Enter to drive"
        )
        command = Command(self.speed_ms, steering_rad)
        servo, steps = drive_arc(motor, command, self.distance_m)
        forward_m = _ask_number("How far along that line did the middle come, metres")
        left_m = _ask_number("How far to its left, metres (right: negative)")
        arc = Arc(servo, steps, forward_m, left_m)
        print(f"Servo {servo:.3f}: {steps} steps of the motor, {arc.length_m:.3f} m.")
        return arc

    def _tell(self, before: Calibration, found: Calibration) -> None:
        for name in ("erpm_per_ms", "servo_per_rad", "servo_centre"):
            print(f"{name} = {getattr(found, name)} (was {getattr(before, name)})")


def _ask(question: str) -> str:
    from mi_nerfattack.errors import InputError

    try:
        return input(f"{question}: ").strip()
    except EOFError as err:
        raise InputError(
            "calibrate: nobody answers its questions; run it in a terminal"
        ) from err


def _confirm(question: str) -> bool:
    return _ask(f"{question} [y/N]").lower() in ("y", "yes")


def _ask_number(question: str) -> float:
    while True:
        given = _ask(question)
        try:
            if math.isfinite(value := float(given.replace(",", "."))):
                return value
        except ValueError:
            pass
        print(f"{given!r} is not a number.")
