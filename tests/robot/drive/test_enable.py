"""The enable button, by the bytes that Linux's joystick driver writes into a FIFO."""

from __future__ import annotations

import os
import struct

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.drive.safety.enable import (
    JoystickEnable,
    ReleasedError,
    check_held,
    wait_for_press,
)

BUTTON, AXIS, INITIAL = 1, 2, 0x80


def event(value: int, kind: int, number: int) -> bytes:
    return struct.pack("<IhBB", 123456, value, kind, number)


@pytest.fixture
def pad(tmp_path):
    """A FIFO, its writing end, and the time."""
    path, time = tmp_path / "js0", [5.0]
    os.mkfifo(path)
    descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    yield str(path), descriptor, time
    try:
        os.close(descriptor)
    except OSError:  # by the test
        pass


def test_a_button_is_held_between_its_events(pad):
    path, descriptor, time = pad
    enable = JoystickEnable(path, 4, lambda: time[0])
    assert not enable.is_held()
    os.write(descriptor, event(1, BUTTON | INITIAL, 3) + event(1, AXIS, 4))
    assert not enable.is_held()
    down = event(1, BUTTON, 4)
    os.write(descriptor, down[:5])
    assert not enable.is_held()
    os.write(descriptor, down[5:] + event(0, BUTTON, 3))
    assert enable.is_held() and enable.is_held()
    os.write(descriptor, event(0, BUTTON, 4))
    assert not enable.is_held()
    os.write(descriptor, event(1, BUTTON | INITIAL, 4))  # after an overflow
    assert enable.is_held()
    enable.close()
    enable.close()
    assert not enable.is_held()


def test_a_link_that_is_silent_holds_nothing(pad):
    path, descriptor, time = pad
    enable = JoystickEnable(path, 0, lambda: time[0], silence_s=0.5)
    os.write(descriptor, event(1, BUTTON, 0))
    assert enable.is_held()
    time[0] += 0.49
    assert enable.is_held()
    os.write(descriptor, event(-7, AXIS, 1))
    assert enable.is_held()
    time[0] += 0.51
    assert not enable.is_held()
    os.write(descriptor, event(7, AXIS, 1))  # the link is back, no finger was seen
    assert not enable.is_held() and not enable.is_held()
    os.write(descriptor, event(1, BUTTON, 0))
    assert enable.is_held()
    time[0] += 0.51
    os.write(descriptor, event(7, AXIS, 1))  # the silence was not looked at
    assert not enable.is_held()
    enable.close()


def test_a_device_that_is_gone_holds_nothing(tmp_path):
    path = tmp_path / "js0"
    os.mkfifo(path)
    enable = None
    try:
        reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        writer = os.open(path, os.O_WRONLY)
        enable = JoystickEnable(str(path), 0, lambda: 0.0)
        os.write(writer, event(1, BUTTON, 0) * 2)
        os.close(reader)
        assert enable.is_held()
        os.close(writer)
        assert not enable.is_held()
    finally:
        if enable is not None:
            enable.close()


def test_a_button_that_is_held_already_is_let_go_first(pad):
    path, descriptor, time = pad
    enable, told, steps = JoystickEnable(path, 4, lambda: time[0]), [], []
    os.write(descriptor, event(1, BUTTON, 4))

    def sleep(seconds: float) -> None:
        steps.append(seconds)
        if len(steps) in (3, 6):
            os.write(descriptor, event(int(len(steps) == 6), BUTTON, 4))

    wait_for_press(enable, sleep, told.append)
    assert len(steps) == 6 and len(told) == 1
    check_held(enable)
    os.write(descriptor, event(0, BUTTON, 4))
    with pytest.raises(ReleasedError, match="let go"):
        check_held(enable)
    enable.close()


def test_a_device_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="js7: does not exist; check the path"):
        JoystickEnable(str(tmp_path / "js7"), 0, lambda: 0.0)
