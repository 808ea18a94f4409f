"""Limits, fence, rounds, pilots and the enable button, each alone."""

from __future__ import annotations

import math
import os
import struct
import sys
import threading
import time
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.devices.car import JUDGE, Bench, StandInTracker
from support.faults.injected import wait_for

from mi_nerfattack.car.devices import (
    Command,
    Decision,
    DeviceLostError,
    Frame,
    MotorValues,
    TrackedPose,
)
from mi_nerfattack.car.drive.pilot import LocalPilot
from mi_nerfattack.car.drive.safety import judge as judging
from mi_nerfattack.car.drive.safety.enable import (
    JoystickEnable,
    ReleasedError,
    check_held,
    wait_for_press,
)
from mi_nerfattack.car.drive.safety.fence import Fence, car_corners
from mi_nerfattack.car.drive.safety.judge import Ages, Judge, Stop
from mi_nerfattack.car.drive.safety.limits import Limits, Steering
from mi_nerfattack.car.drive.safety.speeds import Speeds
from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import planar_body

NUMBER = st.floats(-1e6, 1e6)
LIMITS = Limits(speed_ms=1.5, steering_rad=0.4, acceleration_ms2=2.0, steering_rate=3.0)


@given(NUMBER, NUMBER, st.floats(0, 1.5), st.floats(-0.4, 0.4), st.floats(0, 0.2))
def test_no_command_is_beyond_the_limits(speed, angle, speed_before, before, elapsed):
    last = Command(speed_before, before)
    sent = LIMITS.apply(Command(speed, angle), last, elapsed)
    assert 0 <= sent.speed_ms <= 1.5 and abs(sent.steering_rad) <= 0.4
    assert abs(sent.speed_ms - speed_before) <= 2.0 * elapsed + 1e-12
    assert abs(sent.steering_rad - before) <= 3.0 * elapsed + 1e-12


def test_what_is_within_the_limits_is_sent():
    last = Command(1.0, 0.1)
    assert LIMITS.apply(Command(1.1, -0.1), last, 0.1) == Command(1.1, -0.1)
    for wrong in (Command(math.nan, 0.0), Command(1.0, math.inf)):
        with pytest.raises(InputError, match="must be finite"):
            LIMITS.apply(wrong, last, 0.1)
    with pytest.raises(InputError, match="limits.speed_ms: 0"):
        replace(LIMITS, speed_ms=0.0)


def test_a_heading_rate_becomes_the_angle_that_turns_so_fast():
    angle = Steering("rad/s", 0.325).angle(1.2, 0.8)
    assert 0.8 / 0.325 * math.tan(angle) == pytest.approx(1.2)
    assert Steering("rad", 0.325).angle(0.3, 0.8) == 0.3
    assert abs(Steering("rad/s", 0.325).angle(1.2, 0.0)) < math.pi / 2


def test_a_concave_fence_holds_what_is_inside():
    fence = Fence(np.array([(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)], float))
    inside = np.array([(0.5, 0.5), (3.9, 3.0), (0.2, 3.0), (2.0, 0.9)])
    assert fence.holds(inside)
    for outside in [(2.0, 1.1), (-0.1, 0.5), (2.0, 3.0), (5.0, 0.0), (math.nan, 1.0)]:
        assert not fence.holds(np.array([*inside, outside]))


def judged(fence: Fence, body: np.ndarray) -> None:
    judge = Judge(Ages(), fence, SMALL_CAR, 0.8, 0.1)
    judge.pose(TrackedPose(body, 0.0, 0), 0.0, StandInTracker(Bench()), "car")


@pytest.mark.parametrize("corner", range(4))
@pytest.mark.parametrize("turn", [0.0, 2.2])
def test_each_corner_of_the_car_is_fenced(corner, turn):
    """A fence whose side cuts off one corner, 1 cm of it or none."""
    overhang = 0.5 * (SMALL_CAR.length - SMALL_CAR.wheelbase)
    x = -overhang if corner in (0, 3) else SMALL_CAR.wheelbase + overhang
    y = 0.5 * SMALL_CAR.width * (-1 if corner in (0, 1) else 1)
    body = planar_body(np.array([0.3, -0.2, turn]))
    turned, place = body[:2, :2], body[:2, 3]
    outwards = np.sign((x, y)) / math.sqrt(2)
    along = np.array((-outwards[1], outwards[0]))
    for gap, is_held in ((0.01, True), (-0.01, False)):
        middle = np.array((x, y)) + gap * outwards
        sides = [middle + 3 * along, middle - 3 * along]
        sides += [point - 6 * outwards for point in reversed(sides)]
        fence = Fence(np.array(sides) @ turned.T + place)
        outside = pytest.raises(Stop, match="outside the fence")
        with nullcontext() if is_held else outside:
            judged(fence, body)


@pytest.mark.parametrize("tip", [0.05, -1.5])  # inside the car, beyond it
@pytest.mark.parametrize("turn", [0.0, 1.1, -2.5])
def test_a_fence_does_not_reach_into_the_car(tip, turn):
    spike = [(0.05, 2.0), (0.0, tip), (-0.05, 2.0)]
    square = [(-2.0, 2.0), (-2.0, -2.0), (2.0, -2.0), (2.0, 2.0)]
    body = planar_body(np.array([0.3, -0.2, turn]))

    def placed(points) -> np.ndarray:
        middle = np.array([0.5 * SMALL_CAR.wheelbase, 0.0])
        return (np.array(points) + middle) @ body[:2, :2].T + body[:2, 3]

    corners = car_corners(SMALL_CAR, body)
    fence = Fence(placed([*square, *spike]))
    assert fence.holds(corners) and not fence.encloses(corners)
    assert Fence(placed(square)).encloses(corners)
    with pytest.raises(Stop, match="outside the fence: the car is at x 0.30 m"):
        judged(fence, body)


def test_a_battery_at_its_least_voltage_is_not_low():
    judge = replace(JUDGE, battery_least_v=9.6)
    judge.motor(MotorValues(0.0, input_voltage_v=9.6))
    with pytest.raises(Stop, match="9.5 V, at least 9.6 V"):
        judge.motor(MotorValues(0.0, input_voltage_v=9.5))


def test_values_that_are_read_twice_count_once():
    """The mean over 0.3 s is that of 1, 2 and 3 m/s."""
    speeds = Speeds()
    for tenth, speed_ms in ((0, 5.0), (1, 1.0), (2, 2.0), (3, 3.0), (3, 3.0)):
        speeds.add(None, MotorValues(tenth / 10, speed_ms))
    assert speeds.motor() == pytest.approx(2.0)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell")
def test_the_clock_of_rounds_goes_on_while_the_computer_is_suspended(monkeypatch):
    clocks = {time.CLOCK_BOOTTIME: 7200.0, time.CLOCK_MONOTONIC: 3600.0}
    monkeypatch.setattr(time, "clock_gettime", clocks.__getitem__)
    assert judging.suspended_clock() == 7200.0


def frame(index: int) -> Frame:
    return Frame(np.full((2, 2, 3), index, np.uint8), 0.1 * index, index)


def decision_of(pilot: LocalPilot, index: int) -> Decision:
    wait_for(lambda: (d := pilot.newest()) is not None and d.frame_index == index)
    decision = pilot.newest()
    assert decision is not None
    return decision


def test_a_pilot_decides_of_the_newest_frame():
    begun, go = threading.Event(), threading.Event()

    def control(frame):
        begun.set()
        assert go.wait(10)
        return 0.01 * float(frame.image[0, 0, 0])

    pilot = LocalPilot(lambda: control, lambda: 7.0)
    assert pilot.newest() is None
    pilot.submit(frame(1))
    assert begun.wait(10)
    pilot.submit(frame(2))  # replaced before it is begun with
    pilot.submit(frame(3))
    assert pilot.newest() is None  # it hangs, and nobody waits
    go.set()
    decision = decision_of(pilot, 3)
    assert (decision.control, decision.frame_time_s) == pytest.approx((0.03, 0.3))
    assert decision.time_s == 7.0
    pilot.close()


def test_a_pilot_that_is_reset_forgets_the_frames_before():
    def begin():
        indices = []

        def control(frame):
            indices.append(frame.index)
            return float(len(indices))

        return control

    def decided(index: int) -> float:
        pilot.submit(frame(index))
        return decision_of(pilot, index).control

    pilot = LocalPilot(begin, time.monotonic)
    assert [decided(1), decided(2), decided(3)] == [1.0, 2.0, 3.0]
    pilot.reset()
    assert [decided(4), decided(5)] == [1.0, 2.0]
    pilot.close()


def test_a_pilot_that_fails_is_lost():
    def control(frame):
        raise ValueError("wrong size")

    pilot = LocalPilot(lambda: control, time.monotonic)
    pilot.submit(frame(1))

    wait_for(lambda: pilot._error)
    with pytest.raises(DeviceLostError, match="policy: .*ValueError: wrong size"):
        pilot.newest()
    with pytest.raises(DeviceLostError):
        pilot.submit(frame(2))
    pilot.close()


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
    os.close(descriptor)


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
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(path, os.O_WRONLY)
    with closing(JoystickEnable(str(path), 0, lambda: 0.0)) as enable:
        os.write(writer, event(1, BUTTON, 0) * 2)
        os.close(reader)
        assert enable.is_held()
        os.close(writer)
        assert not enable.is_held()


def test_a_button_that_is_held_already_is_let_go_first(pad):
    path, descriptor, time = pad
    enable, prompts, steps = JoystickEnable(path, 4, lambda: time[0]), [], []
    os.write(descriptor, event(1, BUTTON, 4))

    def sleep(seconds: float) -> None:
        steps.append(seconds)
        if len(steps) in (3, 6):
            os.write(descriptor, event(int(len(steps) == 6), BUTTON, 4))

    wait_for_press(enable, sleep, prompts.append)
    assert len(steps) == 6 and len(prompts) == 1
    check_held(enable)
    os.write(descriptor, event(0, BUTTON, 4))
    with pytest.raises(ReleasedError, match="let go"):
        check_held(enable)
    enable.close()


def test_a_device_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="js7: does not exist; check the path"):
        JoystickEnable(str(tmp_path / "js7"), 0, lambda: 0.0)


@pytest.mark.parametrize("bus", ["0005", "0003", None])
def test_a_bluetooth_pad_needs_a_longest_silence(pad, tmp_path, bus):
    path, _, time = pad
    described = tmp_path / "sys/js0/device/id/bustype"
    if bus is not None:
        described.parent.mkdir(parents=True)
        described.write_text(f"{bus}\n")
    link = tmp_path / "pad"
    link.symlink_to(path)
    of_pad = partial(JoystickEnable, str(link), 5, lambda: time[0])
    if bus == "0005":
        with pytest.raises(InputError, match="a Bluetooth pad, .* give silence_s"):
            of_pad(None, tmp_path / "sys")
    else:
        of_pad(None, tmp_path / "sys").close()
    of_pad(0.5, tmp_path / "sys").close()
