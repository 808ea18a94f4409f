"""The control loop against stand-ins: every fault ends in brake and centre."""

from __future__ import annotations

import errno
import math
import re
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.devices import car as stand_ins
from support.devices.car import FRAME_LATENCY_S, SETTINGS, Bench, StandInCamera

from mi_nerfattack.car.devices import DeviceLostError, Frame
from mi_nerfattack.car.drive.safety.judge import Cause
from mi_nerfattack.car.drive.safety.limits import Steering
from mi_nerfattack.deploy.replay.ros2 import read_topics
from mi_nerfattack.io import growing

#: Longest time from a fault to the first brake: a decision, a frame and a round.
LONGEST_S = 0.3
#: And of a motor controller that hears nothing: its own 0.25 s, a reading and a round.
TIMED_OUT_S = 0.33
#: Mean speeds are over 0.3 s.
SPEED_S = 0.35


def messages(path: Path, topic: str) -> list[Any]:
    return read_topics(path)[0][topic].decode()


def breaks(name: str, error: BaseException):
    return lambda bench: bench.broken.update({name: error})


def falls_silent(name: str):
    return lambda bench: bench.silent.update({name: bench.now})


def sets(**values):
    return lambda bench: vars(bench).update(values)


FAULTS = {
    Cause.RELEASED: sets(held=False),
    Cause.FRAME_OLD: falls_silent("camera"),
    Cause.POSE_OLD: falls_silent("tracker"),
    Cause.OUTSIDE: sets(offset_m=5.0),
    Cause.NOT_FINITE: sets(control=math.nan),
    Cause.OUT_OF_RANGE: sets(control=-0.81),
    Cause.DECISION_OLD: falls_silent("pilot"),
    Cause.CAMERA_LOST: breaks("camera", DeviceLostError("camera: unplugged")),
    Cause.TRACKER_LOST: breaks("tracker", DeviceLostError("tracker: no datagrams")),
    Cause.MOTOR_LOST: breaks("motor", DeviceLostError("serial: gone")),
    Cause.PILOT_LOST: breaks("pilot", DeviceLostError("policy: failed")),
    Cause.MOTOR_FAULT: sets(fault=5),
    Cause.MOTOR_KILLED: sets(killed=True),
    Cause.MOTOR_TIMED_OUT: falls_silent("motor"),
    Cause.LOOP_LATE: sets(stall_s=0.35),
    Cause.TOO_FAST: sets(gain=1.5, motor_gain=1.5),
    Cause.SPEEDS_DIFFER: sets(gain=0.5),
    Cause.BATTERY_LOW: sets(volts=9.4),
    Cause.MOTOR_HOT: sets(celsius=81.0),
    Cause.EXCEPTION: breaks("camera", ZeroDivisionError("a mistake")),
    Cause.INTERRUPTED: breaks("signal", KeyboardInterrupt()),
}


def check_fault(cause: Cause, moment_s: float, path: Path) -> None:
    bench = Bench()
    bench.press()
    bench.at(moment_s, lambda: FAULTS[cause](bench))
    judge = replace(SETTINGS.judge, battery_least_v=9.6)
    stop, loop = bench.drive(path, duration_s=60.0, judge=judge)
    assert stop.cause is cause
    assert loop.was_braked == (cause is not Cause.MOTOR_LOST)
    moved = [time for time, what, _ in bench.events if what == "send"]
    # a loop that is late brakes late, but the motor controller does by itself
    brakes = ("brake", "timeout") if cause is Cause.LOOP_LATE else ("brake",)
    braked = [time for time, what, _ in bench.events if what in brakes]
    assert len(moved) >= 3 and moved[-1] < braked[0]
    since = braked[0] - bench.start_s - moment_s
    longest = {
        Cause.MOTOR_TIMED_OUT: TIMED_OUT_S,
        Cause.TOO_FAST: SPEED_S,
        Cause.SPEEDS_DIFFER: SPEED_S,
    }.get(cause, LONGEST_S)
    assert 0 <= since < longest, f"{cause}: braked after {since:.3f} s"
    faults = [item for item in messages(path, "/safety") if item.name == cause.value]
    assert [item.msg for item in faults] == [stop.message]
    assert faults[0].level == (20 if cause is Cause.RELEASED else 50)


@pytest.mark.parametrize("cause", FAULTS)
def test_each_fault_ends_in_brake_and_centre(tmp_path, cause):
    check_fault(cause, 1.2, tmp_path / "drive.mcap")


@pytest.mark.slow
@pytest.mark.parametrize("cause", FAULTS)
def test_each_fault_at_random_moments(tmp_path, cause, rng):
    for index, moment in enumerate(rng.uniform(1.0, 4.0, 50)):
        check_fault(cause, float(moment), tmp_path / f"{index}.mcap")


class StallingSteering:
    """Works out one angle for so long, in which the button is let go."""

    def __init__(self, bench: Bench, stall_s: float, releases: bool) -> None:
        self._bench, self._stall_s, self._releases = bench, stall_s, releases

    def angle(self, control: float, speed_ms: float) -> float:
        bench = self._bench
        if bench.now > bench.start_s + 1.5:
            bench.held = bench.held and not self._releases
            bench.sleep(self._stall_s)
        return control


@pytest.mark.parametrize(
    ("stall_s", "releases", "cause"),
    [
        (0.6, True, Cause.LOOP_LATE),
        (0.1, False, Cause.FRAME_OLD),
        (0.01, True, Cause.RELEASED),
    ],
)
def test_nothing_is_sent_that_was_right_before_a_stall(
    tmp_path, stall_s, releases, cause
):
    bench = Bench()
    bench.press()
    steering = StallingSteering(bench, stall_s, releases)
    stop, _ = bench.drive(tmp_path / "drive.mcap", duration_s=9.0, steering=steering)
    assert stop.cause is cause
    sent = [time for time, what, _ in bench.events if what == "send"]
    assert len(sent) > 5 and sent[-1] <= bench.start_s + 1.5


@pytest.mark.parametrize("moment_s", np.arange(1.5, 1.6, 0.01))
def test_nothing_is_sent_after_the_computer_was_suspended(tmp_path, moment_s):
    bench = Bench()
    bench.press()
    bench.at(moment_s, partial(setattr, bench, "asleep_s", 3600.0))
    stop, _ = bench.drive(tmp_path / "drive.mcap", duration_s=9.0)
    assert stop.cause is Cause.LOOP_LATE and "took 3600" in stop.message
    sent = [time for time, what, _ in bench.events if what == "send"]
    assert len(sent) > 5 and sent[-1] <= bench.start_s + moment_s


def test_an_enable_held_while_the_computer_was_suspended_is_pressed_again(tmp_path):
    bench = Bench()
    bench.silent["camera"] = bench.start_s  # not ready yet
    bench.at(1.0, partial(setattr, bench, "asleep_s", 3600.0))
    bench.at(1.0, bench.silent.clear)
    bench.press(1.0)
    bench.at(2.0, partial(setattr, bench, "held", False))
    bench.press(3.0)
    bench.drive(tmp_path / "drive.mcap", duration_s=1.0)
    assert bench.events[0][0] >= bench.start_s + 3.0


def test_a_full_disk_ends_the_drive(tmp_path, monkeypatch):
    bench = Bench()
    bench.press()

    def full(descriptor, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    bench.at(1.5, lambda: monkeypatch.setattr(growing.os, "write", full))
    stop, _ = bench.drive(tmp_path / "drive.mcap")
    assert stop.cause is Cause.LOG_FAILED
    assert "drive.mcap: no space left on the disk" in stop.message
    assert bench.events[-1][1] == "brake"


def test_a_drive_is_logged_whole(tmp_path):
    path, bench = tmp_path / "drive.mcap", Bench()
    bench.press()
    stop, loop = bench.drive(path, duration_s=3.0)
    assert stop.cause is Cause.TIME_UP
    decisions, commands = messages(path, "/decision"), messages(path, "/command")
    sent = [item for item in decisions if not item.brake]
    assert len(sent) == len(loop.measures.rows) == 30
    assert {b.frame_index - a.frame_index for a, b in pairwise(sent)} == {1}
    assert all(item.brake for item in decisions[30:]) and len(commands) > 40
    assert len(commands) == len(decisions) and not commands[-1].drive.speed
    speeds = [item.drive.speed for item in commands[:30]]
    np.testing.assert_allclose(np.diff(speeds[:10]), 0.1, atol=1e-6)
    assert speeds[-1] == 1.0 and sent[0].asked_speed_ms == 1.0
    frames, poses = messages(path, "/camera/image"), messages(path, "/vehicle/pose")
    assert len(frames) in (29, 30, 31)
    assert abs(len(poses) - 50 * 4) < 5  # and while it comes to rest
    assert len(messages(path, "/ages")) == 30
    motor = messages(path, "/motor")[-1]
    said = motor.speed_ms, motor.has_timed_out, motor.fault_name
    assert said == (0.0, 1, "none") and motor.fet_temperature_c == 40.0
    assert np.isnan(motor.motor_current_a)  # of which the stand-in says nothing


AGAIN = [(3.0, "held", False), (4.0, "held", True)]


@pytest.mark.parametrize(
    ("at_first", "changes", "message"),
    [
        ({"held": True}, [], "ready"),  # as by a stuck button
        ({"killed": True, "held": True}, [(2.0, "killed", False)], "kill switch"),
        (
            {"offset_m": 5.0, "held": True},
            [(2.0, "offset_m", 0.0)],
            "outside the fence: the car is at x",
        ),
    ],
)
def test_nothing_moves_before_the_enable_is_pressed_anew(
    tmp_path, at_first, changes, message
):
    bench, path = Bench(), tmp_path / "drive.mcap"
    vars(bench).update(at_first)
    for time_s, name, value in [*changes, *AGAIN]:
        bench.at(time_s, partial(setattr, bench, name, value))
    bench.drive(path, duration_s=1.0)
    assert bench.events[0][1] == "send"
    assert bench.events[0][0] >= bench.start_s + 4.0
    texts = [item.msg for item in messages(path, "/safety")]
    assert any(message in text for text in texts)
    assert "ready: release the enable button, then hold it" in texts


class FasterCamera(StandInCamera):
    """Gives frames at another rate than the 10 Hz of the control."""

    rate = 10

    def newest(self) -> Frame:
        bench = self._bench
        index = int((bench.now - FRAME_LATENCY_S - bench.start_s) * self.rate)
        return replace(
            super().newest(), index=index, time_s=bench.start_s + index / self.rate
        )


@pytest.mark.parametrize("rate", [10, 30, 60])
def test_frames_go_to_the_pilot_at_the_period_of_control(tmp_path, rate, monkeypatch):
    monkeypatch.setattr(FasterCamera, "rate", rate)
    monkeypatch.setattr(stand_ins, "StandInCamera", FasterCamera)
    bench = Bench()
    bench.press()
    _, loop = bench.drive(tmp_path / "drive.mcap", duration_s=5.0)
    frames = np.array(loop.measures.rows)[:, 1]
    assert np.mean(np.diff(frames)) == pytest.approx(SETTINGS.judge.period_s, rel=0.03)
    assert np.diff(frames).max() < 0.135


@pytest.mark.parametrize("after_s", [20.0, 20.04])  # a frame is being decided on
def test_no_decision_remembers_how_the_car_stood(tmp_path, after_s):
    """The pilot forgets when the button goes down, and what it decided before rests."""
    path, bench = tmp_path / "drive.mcap", Bench()
    bench.press(after_s)
    _, loop = bench.drive(path, duration_s=1.0)
    (reset,) = bench.resets
    assert reset == pytest.approx(bench.start_s + after_s, abs=0.03)
    frames = np.array(loop.measures.rows)[:, 1]
    assert frames[0] > reset - FRAME_LATENCY_S - 1e-9
    assert loop.measures.rows[0][0] - reset < 0.2


@pytest.mark.parametrize(
    ("name", "cause", "message"),
    [
        ("restarted", Cause.MOTOR_LOST, "it has started anew"),
        ("fed", Cause.INTERRUPTED, "fed by another: .* end VESC Tool"),
    ],
)
def test_a_motor_controller_that_would_not_brake_is_not_driven(
    tmp_path, name, cause, message
):
    path, bench = tmp_path / "drive.mcap", Bench()
    setattr(bench, name, True)
    bench.press(1.0)
    bench.at(5.0, lambda: bench.broken.update(signal=KeyboardInterrupt()))
    stop, _ = bench.drive(path)
    assert "send" not in {what for _, what, _ in bench.events}
    texts = [item.msg for item in messages(path, "/safety")]
    assert any(re.search(message, text) for text in texts), texts
    assert stop.cause is cause


def test_lifted_wheels_turn_where_no_tracker_sees_the_car_stand(tmp_path):
    bench = Bench()
    bench.gain = 0.0
    bench.press()
    stop, _ = bench.drive(tmp_path / "a.mcap", duration_s=2.0, is_tracked=False)
    assert stop.cause is Cause.TIME_UP


def test_a_heading_rate_is_steered_by_the_speed_that_the_car_has(tmp_path):
    """A car that is slower than it was told turns as fast as it was told."""
    bench = Bench()
    bench.control, bench.gain, bench.motor_gain = 0.4, 0.8, 0.8
    bench.press()
    steering = Steering("rad/s", 0.325)
    bench.drive(tmp_path / "drive.mcap", duration_s=3.0, steering=steering)
    sent = [command for _, what, command in bench.events if what == "send"]
    angle = math.atan(0.325 * 0.4 / 0.8)
    assert sent[-1].steering_rad == pytest.approx(angle, abs=2e-3)
