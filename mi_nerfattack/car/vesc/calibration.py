"""What a car's metres and radians are to its motor controller: a TOML file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from mi_nerfattack.car.devices import Command
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Acute, NonNegative, Share
from mi_nerfattack.scenario.section import Section, read_section, refuse

_THOUSAND = 1000  # steps of the servo's range, as the controller takes them


class Calibration(Section):
    """Scales and limits of a car (docs/car/reference.md); by default a RACECAR/J's."""

    erpm_per_ms: Annotated[float, Field(ge=100, le=100_000)] = 4614.0
    servo_per_rad: Annotated[float, Field(ge=-10, le=10)] = -1.2135
    servo_centre: Share = 0.5304
    servo_least: Share = 0.15
    servo_most: Share = 0.85
    erpm_least: Annotated[int, Field(ge=0, le=20_000)] = 900
    erpm_most: Annotated[int, Field(ge=1, le=200_000)] = 9228
    steering_most_rad: Acute = 0.34
    brake_current_a: Annotated[float, Field(ge=1, le=200)] = 20.0
    timeout_ms: Annotated[int, Field(ge=150, le=300)] = 250
    battery_least_v: NonNegative = 9.6
    wheelbase_m: Annotated[float, Field(gt=0, le=5)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Calibration:
        if abs(self.servo_per_rad) < 0.1:
            refuse("servo_per_rad", f"{self.servo_per_rad}: the servo hardly moves")
        if not self.servo_least < self.servo_centre < self.servo_most:
            span = f"{self.servo_least} to {self.servo_most}"
            refuse("servo_centre", f"{self.servo_centre} is not within {span}")
        if not self.erpm_least < self.erpm_most:
            refuse("erpm_least", f"{self.erpm_least} is not below erpm_most")
        return self

    @property
    def slowest_ms(self) -> float:
        """Slowest speed that the controller holds."""
        return self.erpm_least / self.erpm_per_ms

    @property
    def fastest_ms(self) -> float:
        """Fastest speed that the program commands."""
        return self.erpm_most / self.erpm_per_ms

    def changed(self, values: Mapping[str, float]) -> Calibration:
        """Return it with other values.

        Raises:
            InputError: a value is not plausible.
        """
        table = self.model_dump() | dict(values)
        return read_section("calibration", Calibration, table, folder="")

    def encode(self, command: Command) -> tuple[int, int]:
        """Return electrical turns a minute and thousandths of the servo's range.

        Both are within the limits, whatever the command; 0 turns are to be braked for.
        """
        fastest = self.erpm_most
        erpm = _clipped(command.speed_ms * self.erpm_per_ms, -fastest, fastest)
        erpm = 0 if abs(erpm) < self.erpm_least else round(erpm)
        limit = self.steering_most_rad
        steering = _clipped(command.steering_rad, -limit, limit)
        servo = self.servo_centre + self.servo_per_rad * steering
        least = math.ceil(self.servo_least * _THOUSAND)
        most = math.floor(self.servo_most * _THOUSAND)
        return erpm, round(_clipped(servo * _THOUSAND, least, most))

    def decode(self, erpm: int, servo: int) -> Command:
        """Return the command that turns and thousandths are."""
        steering = (servo / _THOUSAND - self.servo_centre) / self.servo_per_rad
        return Command(erpm / self.erpm_per_ms, steering)


def _clipped(value: float, least: float, most: float) -> float:
    return min(most, max(least, value))


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration; what the file does not say has its default.

    Raises:
        InputError: the file cannot be read, or a value is not plausible.
    """
    path = Path(path)
    return read_section(
        str(path), Calibration, files.read_toml(path), folder=path.parent
    )


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration.

    Raises:
        InputError: the file cannot be written.
    """
    known = calibration.model_dump(exclude_none=True)
    lines = [f"{name} = {value!r}" for name, value in known.items()]
    head = "# motor controller and steering servo of one car: docs/car/reference.md"
    files.write_text(path, "\n".join([head, *lines, ""]))
