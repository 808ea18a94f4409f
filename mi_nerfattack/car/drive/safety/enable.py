"""The button that a person holds as long as the car may move."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mi_nerfattack.car.devices import AbstractEnable, Clock
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Natural, Seconds

_EVENT = struct.Struct("=IhBB")  # milliseconds, value, type, number
_BUTTON, _INITIAL = 0x01, 0x80
_WAIT_S = 0.02
_BLUETOOTH = "0005"  # BUS_BLUETOOTH of linux/input.h


class ReleasedError(InputError):
    """The button was let go while the car moved."""


def wait_for_press(
    enable: AbstractEnable, sleep: Callable[[float], None], tell: Callable[[str], None]
) -> None:
    """Wait until a button was seen released, and then held.

    Args:
        enable: with the button.
        sleep: waits for seconds.
        tell: shows a line to the person who is to hold it.
    """
    was_released = not enable.is_held()
    tell("Release the enable button, if it is held; hold it as long as it may move.")
    while not (was_released and enable.is_held()):
        was_released = was_released or not enable.is_held()
        sleep(_WAIT_S)


def check_held(enable: AbstractEnable) -> None:
    """Check that a button is held.

    Raises:
        ReleasedError: it is not.
    """
    if not enable.is_held():
        raise ReleasedError("the enable button was let go, or its device is gone")


class JoystickEnable(AbstractEnable):
    """A button of a joystick or gamepad by Linux's ``/dev/input/js0``.

    The driver reports changes only. So a wireless pad that is out of reach reports
    nothing, and its button stays as it was. docs/car/reference.md says which
    pads you can use.

    Args:
        path: of the device.
        button: its number, from 0; ``jstest`` shows it.
        clock: of the loop.
        silence_s: after so many seconds without any event the button counts as let go,
            until it is pressed again; None where the link cannot break unseen.
        inputs: where Linux describes its input devices.

    Raises:
        InputError: the device cannot be opened, or is of Bluetooth without `silence_s`.
    """

    def __init__(
        self,
        path: str,
        button: Natural,
        clock: Clock,
        silence_s: Seconds | None = None,
        inputs: Path = Path("/sys/class/input"),
    ) -> None:
        self._button, self._clock, self._silence_s = button, clock, silence_s
        self._is_pressed, self._heard_s, self._tail = False, clock(), b""
        self._descriptor: int | None = None
        if not hasattr(os, "O_NONBLOCK"):
            raise InputError(f"{path}: joysticks are read on Linux alone")
        bus = inputs / Path(path).resolve().name / "device/id/bustype"
        is_radio = bus.is_file() and bus.read_text().strip() == _BLUETOOTH
        if is_radio and silence_s is None:
            raise InputError(
                f"{path}: a Bluetooth pad, whose button seems held when it is out of "
                "reach; give silence_s for one that sends all the time, or use a cable"
            )
        with files.reported(path):
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)

    def is_held(self) -> bool:
        """Whether the button is down, by all events that have come up to now.

        After a silence the button must be pressed again.
        """
        silence_s = self._silence_s
        if silence_s is not None and self._clock() - self._heard_s > silence_s:
            self._is_pressed = False
        self._read()
        return self._is_pressed and self._descriptor is not None

    def close(self) -> None:
        """Let go of the device; from then on nothing is held."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)

    def _read(self) -> None:
        while self._descriptor is not None:
            try:
                data = os.read(self._descriptor, 64 * _EVENT.size)
            except BlockingIOError:
                return
            except OSError:  # unplugged
                data = b""
            if not data:
                with suppress(OSError):
                    self.close()
                return
            self._heard_s = self._clock()
            data = self._tail + data
            end = len(data) - len(data) % _EVENT.size
            self._tail = data[end:]
            for _, value, kind, number in _EVENT.iter_unpack(data[:end]):
                if kind & ~_INITIAL == _BUTTON and number == self._button:
                    self._is_pressed = value == 1
