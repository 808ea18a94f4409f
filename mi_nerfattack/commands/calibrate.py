"""``mi-nerfattack car calibrate``: speed and steering of a car, measured on a floor."""

from __future__ import annotations

import math
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from mi_nerfattack.commands.shared.terminal import Result, ask, confirm, say

if TYPE_CHECKING:
    from mi_nerfattack.car.devices import AbstractEnable
    from mi_nerfattack.car.vesc.calibration import Calibration
    from mi_nerfattack.car.vesc.guided import Arc, Drive
    from mi_nerfattack.car.vesc.motor import VescMotor

_FASTEST_MS, _FARTHEST_M = 1.5, 5.0


@dataclass(frozen=True)
class Calibrate:
    """Find the scales of a car's motor and steering servo, and write them to a file.

    Makes three short drives, straight, to the left and to the right; you measure each
    with a tape. It asks before the car moves, and the car moves only while you hold a
    button. Letting the button go brakes, as Ctrl-C does. A file next to the output
    keeps your measurements until the output is written, so the same command continues.
    """

    continues: ClassVar[bool] = True

    port: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PORT")]
    """Serial port of the VESC, such as /dev/ttyACM0."""
    output: Path
    """File for the calibration (.toml); one that exists is not written over."""
    calibration: Path | None = None
    """File to begin with; by default the scales of a RACECAR/J."""
    wheelbase_m: float | None = None
    """From the front to the rear axle, metres: 0.325. Kept in the file."""
    speed_ms: float = 0.5
    """Speed of the drives, up to 1.5."""
    distance_m: float = 1.5
    """Length of each drive, up to 5, by the calibration that it begins with."""
    steering_rad: float = 0.2
    """Steering of the drives that turn, by that calibration."""
    baudrate: int = 115_200
    """Of the port, if it is a UART."""
    enable: str = "/dev/input/js0"
    """Joystick with the button to hold."""
    button: int = 5
    """Its number, from 0."""
    silence_s: float | None = None
    """Seconds without any event of the joystick after which the button counts as let
    go; for wireless ones that send all the time. Never by default."""
    json: bool = False
    """End with one line of JSON: the scales, and how well the drives agree."""

    def run(self) -> Result:
        """Ask, arm, drive, ask, fit and write."""
        from mi_nerfattack.car.vesc.calibration import (
            Calibration,
            read_calibration,
            write_calibration,
        )
        from mi_nerfattack.car.vesc.guided import DRIVES, fit_arcs, read_arcs
        from mi_nerfattack.deploy.car import SMALL_CAR
        from mi_nerfattack.errors import InputError

        before = Calibration()
        if self.calibration is not None:
            before = read_calibration(self.calibration)
        self._check(before)
        wheelbase_m = self.wheelbase_m or before.wheelbase_m or SMALL_CAR.wheelbase
        arcs_path = self.output.with_name(f"{self.output.name}.arcs.json")
        arcs = read_arcs(arcs_path)
        if arcs:
            print(f"{arcs_path} has {', '.join(arcs)}; remove it to drive these again.")
        if arcs.keys() < DRIVES.keys():
            self._drive(before, arcs, arcs_path)
        try:
            calibration, away_rad, spread = fit_arcs(
                list(arcs.values()), wheelbase_m, before
            )
        except InputError as error:
            raise InputError(
                f"{error}; {arcs_path} has what was measured: take out what is wrong, "
                "and call this again"
            ) from error
        write_calibration(self.output, calibration)
        arcs_path.unlink()
        document = {
            "output": str(self.output),
            "calibration": calibration.model_dump(mode="json"),
            "before": before.model_dump(mode="json"),
            "length_spread": float(spread),
            "steering_away_rad": float(away_rad),
        }

        def show() -> None:
            for name in ("erpm_per_ms", "servo_per_rad", "servo_centre"):
                print(
                    f"{name} = {getattr(calibration, name)} "
                    f"(was {getattr(before, name)})"
                )
            print(
                f"Lengths agree to {spread:.1%}, steering angles to "
                f"{math.degrees(away_rad):.1f} degrees. Written to {self.output}."
            )

        return Result(document, show)

    def _drive(
        self, before: Calibration, arcs: dict[Drive, Arc], arcs_path: Path
    ) -> None:
        """Arm, and add the drives that are missing; each is kept at once."""
        from mi_nerfattack.car.drive.safety.enable import (
            JoystickEnable,
            check_held,
            wait_for_press,
        )
        from mi_nerfattack.car.vesc.guided import DRIVES, write_arcs
        from mi_nerfattack.car.vesc.motor import VescMotor

        pad = JoystickEnable(
            self.enable, self.button, time.monotonic, silence_s=self.silence_s
        )
        with (
            closing(pad),
            closing(
                VescMotor(self.port, before, confirm, baudrate=self.baudrate)
            ) as motor,
        ):
            print(f"{self.port}: firmware {motor.firmware}")
            ask("Lift the wheels off the ground: they turn for a second. Enter")
            wait_for_press(pad, time.sleep, say)
            motor.arm(lambda: check_held(pad))
            say(
                f"Armed: without commands it brakes after {before.timeout_ms} ms with "
                f"{before.brake_current_a:g} A."
            )
            for name, sign in DRIVES.items():
                if name not in arcs:
                    angle = sign * self.steering_rad
                    arcs[name] = self._measure(motor, pad, name, steering_rad=angle)
                    write_arcs(arcs_path, arcs)

    def _check(self, before: Calibration) -> None:
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io import files

        bounds = {
            "wheelbase_m": (0.0, 5.0),
            "speed_ms": (before.slowest_ms, min(_FASTEST_MS, before.fastest_ms)),
            "distance_m": (0.1, _FARTHEST_M),
            "steering_rad": (0.0, before.steering_most_rad),
        }
        for name, (least, most) in bounds.items():
            value = getattr(self, name)
            if value is not None and not least < value <= most:
                raise InputError(
                    f"--{name.replace('_', '-')}: {value}; more than {least:.3g}, at "
                    f"most {most:g}"
                )
        if self.output.exists():
            raise InputError(f"{self.output}: exists; choose another file")
        files.check_writable(self.output)

    def _measure(
        self, motor: VescMotor, pad: AbstractEnable, name: str, steering_rad: float
    ) -> Arc:
        """Drive until a drive was not broken off, and ask how far it came."""
        from mi_nerfattack.car.devices import Command
        from mi_nerfattack.car.drive.safety.enable import (
            ReleasedError,
            check_held,
            wait_for_press,
        )
        from mi_nerfattack.car.vesc.guided import drive_arc, room_m

        room = room_m(self.distance_m, self.speed_ms)
        command = Command(self.speed_ms, steering_rad)
        while True:
            ask(
                f"Drive {name}, about {self.distance_m:g} m at {self.speed_ms:g} m/s. "
                f"Put the car on the floor with {room:.1f} m free, and more if its "
                "scale of speed may be wrong; mark where the middle of its rear axle "
                "stands, and the line straight ahead. Enter"
            )
            wait_for_press(pad, time.sleep, say)
            try:
                servo, steps = drive_arc(
                    motor, command, self.distance_m, check=lambda: check_held(pad)
                )
            except ReleasedError as error:
                print(f"Braked: {error}. Once more.")
            else:
                return _ask_for_arc(servo, steps)


def _ask_for_arc(servo: float, steps: int) -> Arc:
    """Ask where a drive ended, until the answer is confirmed and tells anything."""
    from mi_nerfattack.car.vesc.guided import Arc
    from mi_nerfattack.errors import InputError

    while True:
        forward_m = _ask_number("How far along that line did the middle come, metres")
        left_m = _ask_number("How far to its left, metres (right: negative)")
        arc = Arc(servo, steps, forward_m, left_m=left_m)
        try:
            arc.check()
        except InputError as error:
            print(error)
            continue
        print(
            f"Servo {servo:.3f}, {steps} steps of the motor: {forward_m:g} m ahead, "
            f"{left_m:g} m to the left, a way of {arc.length_m:.3f} m."
        )
        if ask("Is that right? [Y/n]").lower() not in ("n", "no"):
            return arc


def _ask_number(question: str) -> float:
    while True:
        answer = ask(question)
        try:
            if math.isfinite(value := float(answer.replace(",", "."))):
                return value
        except ValueError:
            pass
        print(f"{answer!r} is not a number.")
