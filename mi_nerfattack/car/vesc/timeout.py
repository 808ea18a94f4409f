"""The timeout of a VESC: set, read back, and proven by turning wheels.

When no command has come for `timeout_msec`, the firmware brakes with
`timeout_brake_current`. As it is delivered it waits a second and then rolls; the car is
not armed before both are what the calibration says, and the wheels have shown it.

Source: VESC firmware, timeout.c and confgenerator.c of versions 3.58 to 7.01, whose
configuration of the application begins alike: signature (4 bytes), controller (1),
timeout (4), brake current (4).
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable

from mi_nerfattack.car.vesc.calibration import Calibration
from mi_nerfattack.car.vesc.link import SerialLink
from mi_nerfattack.car.vesc.messages import (
    VALUES_QUESTION,
    Firmware,
    Id,
    Values,
    fault_name,
    parse_values,
    set_rpm,
)
from mi_nerfattack.errors import InputError

_HEAD, _TIMEOUT = struct.Struct(">BIB"), struct.Struct(">If")
_KNOWN = (3, 58), (8, 0)
_WITHOUT_FLASH = (6, 0)
_ANSWER_S, _FLASH_S = 0.5, 2.0
#: Speed, m/s, of the wheels in the proof, and seconds in which they must reach it.
PROOF_SPEED_MS, _TURN_S = 0.5, 3.0
_MARGIN_S, _STOP_S = 0.05, 0.5
# An answer that is later than this past the limit leaves open when the timeout fired.
_LATE_S, _TRIES = 0.2, 5
# A current brakes that is more than this of the one asked for, and of that before.
_SHARE, _RISE = 0.25, 1.5

#: Answers a question; True is yes.
Confirm = Callable[[str], bool]


def set_timeout(
    link: SerialLink, firmware: Firmware, calibration: Calibration, confirm: Confirm
) -> None:
    """Give the controller the calibration's timeout and brake current.

    From firmware 6.00 on they are in its memory until it is switched off. An older one
    has them written to its flash, once, if `confirm` allows it. Nothing is written
    where they are right.

    Raises:
        InputError: it does not say whether its timeout has fired, its configuration is
            of an unknown layout, was not allowed to be written, or reads back otherwise
            than it was written.
        DeviceLostError: no answer.
    """
    if _values(link)[1].has_timed_out is None:
        raise InputError(
            f"VESC: firmware {firmware} does not say whether its timeout has fired, so "
            "nothing can be proven; update it to 5.03 or later with VESC Tool"
        )
    before = _configuration(link, firmware)
    patched, end = _patched(before, calibration), _HEAD.size + _TIMEOUT.size
    if patched == before:
        return
    kind = Id.SET_APPCONF_NO_STORE
    if (firmware.major, firmware.minor) < _WITHOUT_FLASH:
        kind = Id.SET_APPCONF
        _ask_for_flash(firmware, before, calibration, confirm=confirm)
    link.ask(bytes([kind]) + patched[1:], _FLASH_S)
    after = _configuration(link, firmware)
    if after[: _HEAD.size] + after[end:] != before[: _HEAD.size] + before[end:]:
        raise InputError(
            "VESC: more of its configuration than its timeout has changed; look at it "
            "in VESC Tool (App Settings) before it is driven"
        )
    if after != patched:
        raise InputError(
            f"VESC: its timeout stays {_timeout_text(after)} though it was set; "
            f"{_by_hand(calibration)}"
        )


def has_timeout(link: SerialLink, firmware: Firmware, calibration: Calibration) -> bool:
    """Whether the controller has the calibration's timeout and brake current.

    Raises:
        InputError: its configuration is of an unknown layout.
        DeviceLostError: no answer.
    """
    configuration = _configuration(link, firmware)
    return _patched(configuration, calibration) == configuration


def prove_timeout(
    link: SerialLink, calibration: Calibration, check: Callable[[], None]
) -> None:
    """Turn the wheels, fall silent, and see the controller brake them.

    Args:
        link: to it.
        calibration: of the car.
        check: called while the wheels may turn; what it raises ends the proof.

    Raises:
        InputError: the wheels do not turn, it does not brake in time, or they only
            roll to a stop.
        DeviceLostError: no answer.
    """
    limit_s, is_braked = calibration.timeout_ms / 1000 + _MARGIN_S, True
    for _ in range(_TRIES):
        silent, turning = _turn_wheels(link, calibration, check)
        late, readings = _fall_silent(link, silent, limit_s, check=check)
        if not readings[-1].has_timed_out:
            raise InputError(
                f"VESC: {1000 * limit_s:.0f} ms after the last command it does not "
                f"brake, though its timeout reads {calibration.timeout_ms} ms; do not "
                "drive with it"
            )
        readings += _see_it_brake(link, turning, readings[-1], check=check)
        is_braked = _is_braked(readings, calibration.brake_current_a)
        if is_braked and late < limit_s + _LATE_S:
            return
    if not is_braked:
        raise InputError(
            "VESC: its timeout fires, but the wheels roll to a stop: it never shows a "
            f"quarter of {calibration.brake_current_a:g} A; raise brake_current_a, or "
            "the motor's own limits (VESC Tool: Motor Settings)"
        )
    raise InputError(
        f"VESC: this computer was too busy, {_TRIES} times, to see when the timeout "
        "fired; end other programs"
    )


def _turn_wheels(
    link: SerialLink, calibration: Calibration, check: Callable[[], None]
) -> tuple[float, int]:
    """Return when the last command was sent, and how fast the wheels turned by then."""
    erpm = round(PROOF_SPEED_MS * calibration.erpm_per_ms)
    end = time.monotonic() + _TURN_S
    while True:
        check()
        sent = time.monotonic()
        link.send(set_rpm(erpm))
        _, values = _watch(link, check)
        turning = values.erpm or 0
        if turning > 0.8 * erpm and not values.has_timed_out:
            return sent, turning
        if sent > end:
            raise InputError(
                f"VESC: told to turn the wheels at {erpm} ERPM, it reports {turning} "
                f"after {_TURN_S:g} s; check battery, motor and kill switch"
            )
        time.sleep(0.02)


def _fall_silent(
    link: SerialLink, silent: float, limit_s: float, check: Callable[[], None]
) -> tuple[float, list[Values]]:
    """Return all values up to the first asked for past the limit, and how late."""
    readings: list[Values] = []
    while True:
        time.sleep(0.01)
        asked = time.monotonic()
        heard, values = _watch(link, check)
        readings.append(values)
        if asked > silent + limit_s:
            return heard - silent, readings


def _see_it_brake(
    link: SerialLink, turning: int, values: Values, check: Callable[[], None]
) -> list[Values]:
    """Return the values that follow, until the wheels are at half their speed."""
    end, readings = time.monotonic() + _STOP_S, []
    while abs(values.erpm or 0) > turning / 2:
        if time.monotonic() > end:
            raise InputError(
                f"VESC: its timeout fires, but the wheels turn on at {values.erpm} of "
                f"{turning} ERPM; raise brake_current_a, or the motor's own limit"
            )
        time.sleep(0.01)
        _, values = _watch(link, check)
        readings.append(values)
    return readings


def _is_braked(readings: list[Values], brake_current_a: float) -> bool:
    """Whether a current brakes: lifted wheels come to rest without one, too.

    Each value is a mean since the one before. Its sign tells nothing: so slowly, even
    braking takes power.
    """
    turning = [_current(values) for values in readings if not values.has_timed_out]
    braking = [_current(values) for values in readings if values.has_timed_out]
    held_a = turning[-1] if turning else 0.0
    return max(braking) > max(_SHARE * brake_current_a, _RISE * held_a)


def _current(values: Values) -> float:
    return abs(values.motor_current_a or 0.0)


def _watch(link: SerialLink, check: Callable[[], None]) -> tuple[float, Values]:
    """Return when values came, and them; refuse what makes them prove nothing."""
    check()
    heard, values = _values(link)
    if values.fault:
        name = fault_name(values.fault)
        raise InputError(f"VESC: fault {values.fault} ({name}); mend it first")
    if values.is_killed:
        raise InputError("VESC: its kill switch is pressed; let it go, and arm again")
    return heard, values


def _values(link: SerialLink) -> tuple[float, Values]:
    answer = link.ask(VALUES_QUESTION, _ANSWER_S)
    return answer.time_s, parse_values(answer.payload)


def _configuration(link: SerialLink, firmware: Firmware) -> bytes:
    """Return the answer to GET_APPCONF, of a firmware whose layout is known."""
    raw = link.ask(bytes([Id.GET_APPCONF]), _ANSWER_S, tries=3).payload
    least, below = _KNOWN
    known = least <= (firmware.major, firmware.minor) < below
    if known and len(raw) > _HEAD.size + _TIMEOUT.size:
        timeout_ms, current_a = _TIMEOUT.unpack_from(raw, _HEAD.size)
        if timeout_ms <= 3_600_000 and 0 <= current_a <= 1000:
            return raw
    raise InputError(
        f"VESC: firmware {firmware}, signature {int.from_bytes(raw[1:5], 'big')}, "
        f"configuration of {len(raw)} bytes that begins {raw[:14].hex(' ')}: where its "
        "timeout is, is known of 3.58 to 7.x alone; it cannot be armed"
    )


def _patched(configuration: bytes, calibration: Calibration) -> bytes:
    """Return a configuration with the calibration's timeout and brake current."""
    packed = _TIMEOUT.pack(calibration.timeout_ms, calibration.brake_current_a)
    end = _HEAD.size + _TIMEOUT.size
    return configuration[: _HEAD.size] + packed + configuration[end:]


def _timeout_text(configuration: bytes) -> str:
    timeout_ms, current_a = _TIMEOUT.unpack_from(configuration, _HEAD.size)
    return f"{timeout_ms} ms with {current_a:g} A"


def _by_hand(calibration: Calibration) -> str:
    return (
        f"set {calibration.timeout_ms} ms and {calibration.brake_current_a:g} A in "
        "VESC Tool (App Settings, General, Timeout)"
    )


def _ask_for_flash(
    firmware: Firmware, before: bytes, calibration: Calibration, confirm: Confirm
) -> None:
    question = (
        f"The controller (firmware {firmware}) has a timeout of "
        f"{_timeout_text(before)}. Write {calibration.timeout_ms} ms with "
        f"{calibration.brake_current_a:g} A to its flash memory?"
    )
    if not confirm(question):
        raise InputError(
            f"VESC: firmware {firmware} keeps its timeout of "
            f"{_timeout_text(before)} unless its flash memory may be written; allow "
            f"it, or {_by_hand(calibration)}"
        )
