"""The commands to a VESC and its answers: the payloads of its frames.

Numbers are integers, high byte first. A fraction is sent as its value times a scale,
cut towards zero.

Source: VESC firmware, datatypes.h and comm/commands.c.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from mi_nerfattack.errors import InputError


class Id(IntEnum):
    """First byte of a payload. An answer has that of its question."""

    FW_VERSION = 0
    GET_VALUES = 4
    SET_CURRENT_BRAKE = 7
    SET_RPM = 8
    SET_SERVO_POS = 12
    SET_APPCONF = 16
    GET_APPCONF = 17
    GET_VALUES_SELECTIVE = 50
    SET_APPCONF_NO_STORE = 149


@dataclass(frozen=True)
class Firmware:
    """A controller's firmware.

    Args:
        major, minor: of its version; 5.02 is 5 and 2.
        hardware: name of the board.
    """

    major: int
    minor: int
    hardware: str

    def __str__(self) -> str:
        return f"{self.major}.{self.minor:02d} on {self.hardware or 'unnamed hardware'}"


@dataclass(frozen=True)
class Values:
    """What a controller measures; None where its answer has no such field.

    Args:
        fet_temperature_c, motor_temperature_c: degrees Celsius.
        motor_current_a, input_current_a: amperes, mean since the last reading.
        erpm: electrical turns a minute, forward.
        input_voltage_v: volts.
        tachometer, tachometer_absolute: steps since it was switched on, six to an
            electrical turn, backward ones counted down or up.
        fault: its number, 0 for none.
        status: bit 0 is set when the timeout has fired, bit 1 by the kill switch.
    """

    fet_temperature_c: float | None = None
    motor_temperature_c: float | None = None
    motor_current_a: float | None = None
    input_current_a: float | None = None
    erpm: int | None = None
    input_voltage_v: float | None = None
    tachometer: int | None = None
    tachometer_absolute: int | None = None
    fault: int | None = None
    status: int | None = None

    @property
    def has_timed_out(self) -> bool | None:
        """Whether the controller brakes because nobody commands it."""
        return None if self.status is None else bool(self.status & 1)

    @property
    def is_killed(self) -> bool | None:
        """Whether its kill switch is pressed."""
        return None if self.status is None else bool(self.status & 2)


# In the order of the answer, which is that of the bits of a mask: how each is written,
# what it is multiplied with, and its name, where anybody asks for it.
_FIELDS: tuple[tuple[str, float, str | None], ...] = (
    (">h", 10, "fet_temperature_c"),
    (">h", 10, "motor_temperature_c"),
    (">i", 100, "motor_current_a"),
    (">i", 100, "input_current_a"),
    (">i", 100, None),  # i_d
    (">i", 100, None),  # i_q
    (">h", 1000, None),  # duty
    (">i", 1, "erpm"),
    (">h", 10, "input_voltage_v"),
    *(4 * ((">i", 1e4, None),)),  # Ah and Wh, used and charged
    (">i", 1, "tachometer"),
    (">i", 1, "tachometer_absolute"),
    (">B", 1, "fault"),
    (">i", 1e6, None),  # position
    (">B", 1, None),  # controller
    (">hhh", 10, None),  # temperatures of the MOSFETs
    (">i", 1000, None),  # v_d
    (">i", 1000, None),  # v_q
    (">B", 1, "status"),
)
_ALL = (1 << len(_FIELDS)) - 1
_FAULTS = (
    "none, over voltage, under voltage, gate driver, absolute over current, "
    "over temperature of the MOSFETs, over temperature of the motor, "
    "gate driver over voltage, gate driver under voltage, "
    "under voltage of the microcontroller, restarted by its watchdog, encoder, "
    "encoder, encoder, damaged flash, offset of current sensor 1, "
    "offset of current sensor 2, offset of current sensor 3, unbalanced currents, "
    "brake, resolver, resolver, resolver, damaged flash of the app's configuration, "
    "damaged flash of the motor's configuration, no magnet at the encoder, "
    "too strong a magnet at the encoder, phase filter, encoder, low voltage output, "
    "slip of the encoder, too fast, too slow, far too fast"
).split(", ")


def fault_name(number: int) -> str:
    """Return the name of a fault; of one that is not known, its number."""
    return _FAULTS[number] if number < len(_FAULTS) else f"fault {number}"


def set_rpm(erpm: int) -> bytes:
    """Hold a speed, electrical turns a minute; below its least it lets go instead."""
    return struct.pack(">Bi", Id.SET_RPM, erpm)


def set_current_brake(current_a: float) -> bytes:
    """Brake with a current, amperes."""
    return struct.pack(">Bi", Id.SET_CURRENT_BRAKE, int(current_a * 1000))


def set_servo_position(thousandths: int) -> bytes:
    """Move the servo to so many thousandths of its range."""
    return struct.pack(">Bh", Id.SET_SERVO_POS, thousandths)


def get_values(*names: str) -> bytes:
    """Ask for some of `Values` by name, or with no name for all that there are."""
    if not names:
        return bytes([Id.GET_VALUES])
    mask = sum(1 << bit for bit, field in enumerate(_FIELDS) if field[2] in names)
    return struct.pack(">BI", Id.GET_VALUES_SELECTIVE, mask)


#: What the motor asks for while it drives.
VALUES_QUESTION = get_values(
    "fet_temperature_c",
    "motor_current_a",
    "erpm",
    "input_voltage_v",
    "tachometer",
    "tachometer_absolute",
    "fault",
    "status",
)


def parse_values(payload: bytes) -> Values:
    """Read an answer to `get_values` as far as it goes: firmwares differ at its end."""
    mask, offset = _ALL, 1
    if payload[0] == Id.GET_VALUES_SELECTIVE:
        mask, offset = int.from_bytes(payload[1:5], "big"), 5
    numbers: dict[str, float] = {}
    for bit, (kind, scale, name) in enumerate(_FIELDS):
        if not mask >> bit & 1:
            continue
        end = offset + struct.calcsize(kind)
        if end > len(payload):
            break
        if name is not None:
            (value,) = struct.unpack_from(kind, payload, offset)
            numbers[name] = value if scale == 1 else value / scale
        offset = end
    return Values(**numbers)  # pyright: ignore[reportArgumentType]


def parse_firmware(payload: bytes) -> Firmware:
    """Read an answer to FW_VERSION.

    Raises:
        InputError: older than 3.40, whose values lie at other bytes, or cut short.
    """
    if len(payload) < 3:
        raise InputError(
            f"VESC: its version is cut short ({payload.hex(' ')}); is it a VESC?"
        )
    name = payload[3:].partition(b"\0")[0].decode("ascii", "replace")
    firmware = Firmware(payload[1], payload[2], name)
    if (firmware.major, firmware.minor) < (3, 40):
        raise InputError(
            f"VESC: firmware {firmware}; its values lie at other bytes than those of "
            "3.40 and later: update it with VESC Tool"
        )
    return firmware
