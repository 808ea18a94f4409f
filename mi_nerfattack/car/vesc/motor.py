"""A car's motor and steering servo at a VESC."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress

from mi_nerfattack.car.devices import (
    AbstractMotor,
    Command,
    DeviceLostError,
    MotorValues,
)
from mi_nerfattack.car.vesc.calibration import Calibration
from mi_nerfattack.car.vesc.link import BAUDRATE, SerialLink
from mi_nerfattack.car.vesc.messages import (
    VALUES_QUESTION,
    Id,
    Values,
    fault_name,
    parse_firmware,
    parse_values,
    set_current_brake,
    set_rpm,
    set_servo_position,
)
from mi_nerfattack.car.vesc.timeout import (
    Confirm,
    has_timeout,
    prove_timeout,
    set_timeout,
)
from mi_nerfattack.errors import InputError

_VERSION_S = 0.5


class VescMotor(AbstractMotor):
    """A VESC at a serial port, with the steering servo at its servo output.

    No thread of this class commands it: when its caller hangs, is stopped or killed,
    the controller's own timeout brakes.

    Args:
        port: name of the serial port.
        calibration: scales and limits of the car.
        confirm: is asked whether the flash memory of a firmware before 6.00 may be
            written; by default it may not.
        baudrate: of a UART; a USB port takes any.
        silence_s: longest wait for values, seconds, before the controller is lost.

    Attributes:
        calibration: as given.
        firmware: of the controller.
        values: all that was last read.

    Raises:
        InputError: the port cannot be opened, or the firmware is older than 3.40.
        DeviceLostError: no answer.
    """

    def __init__(
        self,
        port: str,
        calibration: Calibration | None = None,
        confirm: Confirm = lambda question: False,
        baudrate: int = BAUDRATE,
        silence_s: float = 0.5,
    ) -> None:
        self.calibration = calibration or Calibration()
        self._confirm, self._silence_s = confirm, silence_s
        self._is_armed = self._has_moved = False
        self._waits_since: float | None = None  # the first question with no answer
        self._way = 0
        self.values = Values()
        self._link = SerialLink(port, baudrate)
        try:
            version = self._link.ask(bytes([Id.FW_VERSION]), _VERSION_S, tries=2)
            self.firmware = parse_firmware(version.payload)
        except BaseException:
            self._link.close()
            raise

    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        """Set the timeout, prove it by turning the wheels, and let the car move.

        The wheels turn at 0.5 m/s for about a second: lift them off the ground.

        Args:
            check: called before each command and reading while they may turn; what it
                raises ends this, braked and not armed.

        Raises:
            InputError: it is not proven; the message says what to do.
            DeviceLostError: no answer.
        """
        self._is_armed, self._has_moved = False, True
        try:
            set_timeout(
                self._link, self.firmware, self.calibration, confirm=self._confirm
            )
            prove_timeout(self._link, self.calibration, check)
        finally:
            self.brake()
        self._waits_since, self._way = None, 0
        self._is_armed = True

    def check(self) -> None:
        """See `AbstractMotor.check`: its configuration is still as it was set.

        A controller that was switched off has forgotten what is in its memory, and its
        counters may have passed their former values before anybody reads them.
        """
        if not has_timeout(self._link, self.firmware, self.calibration):
            self._lose("it has started anew, and forgotten its timeout")

    def send(self, command: Command) -> Command:
        """Send a command, which is the only sign of life that the controller gets.

        It brakes for standstill and for what is slower than the controller can hold.

        Returns:
            What was really sent, within the calibration's limits and in the steps of
            the controller.

        Raises:
            InputError: not armed, or not finite.
            DeviceLostError: it cannot be sent, or no answer could be heard.
        """
        if not self._is_armed:
            raise InputError("VESC: not armed; call arm() with the wheels lifted")
        if not (
            math.isfinite(command.speed_ms) and math.isfinite(command.steering_rad)
        ):
            raise InputError(f"VESC: {command}; speed and steering must be finite")
        erpm, servo = self.calibration.encode(command)
        current_a = self.calibration.brake_current_a
        turn = set_rpm(erpm) if erpm else set_current_brake(current_a)
        self._link.check()
        self._link.send(set_servo_position(servo), turn)
        return self.calibration.decode(erpm, servo)

    def brake(self) -> None:
        """See `AbstractMotor.brake`."""
        _, centre = self.calibration.encode(Command(0.0, 0.0))
        self._link.send(
            set_current_brake(self.calibration.brake_current_a),
            set_servo_position(centre),
        )

    def read(self) -> MotorValues | None:
        """Return the newest values, for which it asks without waiting; None at first.

        Raises:
            DeviceLostError: the controller has fallen silent, or has restarted and
                forgotten its timeout; arm the car again.
        """
        answer, now = self._link.newest(Id.GET_VALUES_SELECTIVE), time.monotonic()
        waits_since = self._waits_since or now
        if answer is not None and answer.time_s >= waits_since:
            waits_since = now
        if now > waits_since + self._silence_s:
            self._lose(f"no answer for {now - waits_since:.2f} s")
        self._waits_since = waits_since
        self._link.send(VALUES_QUESTION)
        if answer is None:
            return None
        self.values = values = parse_values(answer.payload)
        if (values.tachometer_absolute or 0) < self._way:
            self._lose("it has started anew")
        self._way = values.tachometer_absolute or 0
        return self._motor_values(values, answer.time_s)

    def close(self) -> None:
        """Let go of the port, after a brake if it was armed; twice does no harm."""
        self._is_armed = False
        if self._has_moved:
            with suppress(DeviceLostError):
                self.brake()
        self._link.close()

    def _lose(self, reason: str) -> None:
        self._is_armed = False
        raise DeviceLostError(
            f"{self._link.port}: {reason}; check cable and battery, and arm it again"
        )

    def _motor_values(self, values: Values, time_s: float) -> MotorValues:
        speed = (
            None if values.erpm is None else values.erpm / self.calibration.erpm_per_ms
        )
        return MotorValues(
            time_s=time_s,
            speed_ms=speed,
            motor_current_a=values.motor_current_a,
            input_voltage_v=values.input_voltage_v,
            fet_temperature_c=values.fet_temperature_c,
            fault=values.fault or 0,
            fault_name=fault_name(values.fault or 0),
            has_timed_out=values.has_timed_out,
            is_killed=values.is_killed,
        )
