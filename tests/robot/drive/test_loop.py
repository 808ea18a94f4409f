"""The control loop against stand-ins: every fault ends in brake and centre."""

from __future__ import annotations

import errno
import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.driving_stand_ins import SETTINGS, Bench

from mi_nerfattack.io import growing
from mi_nerfattack.robot.devices import DeviceLostError
from mi_nerfattack.robot.drive.safety.judge import Cause

HOLD_S = 0.5
#: Longest time from a fault to the first brake: a decision, a frame and a round.
LONGEST_S = 0.3
#: And of a motor controller that hears nothing: its own 0.25 s, a reading and a round.
TIMED_OUT_S = 0.33


def messages(path: Path, topic: str) -> list[dict]:
    reader = pytest.importorskip("mcap.reader")
    with path.open("rb") as stream:
        found = reader.make_reader(stream).iter_messages([topic])
        return [json.loads(message.data) for _, _, message in found]


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
    Cause.EXCEPTION: breaks("camera", ZeroDivisionError("a mistake")),
    Cause.INTERRUPTED: breaks("signal", KeyboardInterrupt()),
}


def check_fault(cause: Cause, moment_s: float, path: Path) -> None:
    bench = Bench()
    bench.at(HOLD_S, partial(setattr, bench, "held", True))
    bench.at(moment_s, lambda: FAULTS[cause](bench))
    stop, loop = bench.drive(path, duration_s=60.0)
    assert stop.cause is cause
    assert loop.was_braked == (cause is not Cause.MOTOR_LOST)
    moved = [time for time, what, _ in bench.events if what == "send"]
    braked = [time for time, what, _ in bench.events if what == "brake"]
    assert len(moved) >= 3 and moved[-1] < braked[0]
    since = braked[0] - bench.start_s - moment_s
    longest = TIMED_OUT_S if cause is Cause.MOTOR_TIMED_OUT else LONGEST_S
    assert 0 <= since < longest, f"{cause}: braked after {since:.3f} s"
    found = [item for item in messages(path, "/safety") if item["name"] == cause.value]
    assert [item["message"] for item in found] == [stop.message]
    assert found[0]["level"] == (2 if cause is Cause.RELEASED else 5)


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
    bench.at(HOLD_S, partial(setattr, bench, "held", True))
    steering = StallingSteering(bench, stall_s, releases)
    stop, _ = bench.drive(tmp_path / "drive.mcap", duration_s=9.0, steering=steering)
    assert stop.cause is cause
    sent = [time for time, what, _ in bench.events if what == "send"]
    assert len(sent) > 5 and sent[-1] <= bench.start_s + 1.5


@pytest.mark.parametrize("moment_s", np.arange(1.5, 1.6, 0.01))
def test_nothing_is_sent_after_the_computer_was_suspended(tmp_path, moment_s):
    bench = Bench()
    bench.at(HOLD_S, partial(setattr, bench, "held", True))
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
    bench.at(1.0, partial(setattr, bench, "held", True))
    bench.at(2.0, partial(setattr, bench, "held", False))
    bench.at(3.0, partial(setattr, bench, "held", True))
    bench.drive(tmp_path / "drive.mcap", duration_s=1.0)
    assert bench.events[0][0] >= bench.start_s + 3.0


def test_a_full_disk_ends_the_drive(tmp_path, monkeypatch):
    bench = Bench()
    bench.at(HOLD_S, partial(setattr, bench, "held", True))

    def full(descriptor, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    bench.at(1.5, lambda: monkeypatch.setattr(growing.os, "write", full))
    stop, _ = bench.drive(tmp_path / "drive.mcap")
    assert stop.cause is Cause.LOG_FAILED
    assert "drive.mcap: no space left on the disk" in stop.message
    assert bench.events[-1][1] == "brake"


def test_a_drive_is_logged_whole(tmp_path):
    path, bench = tmp_path / "drive.mcap", Bench()
    bench.at(HOLD_S, partial(setattr, bench, "held", True))
    stop, loop = bench.drive(path, duration_s=3.0)
    assert stop.cause is Cause.TIME_UP
    commands = messages(path, "/command")
    sent = [item for item in commands if not item["brake"]]
    assert len(sent) == len(loop.measures.rows) == 30
    assert [item["frame_index"] for item in sent] == list(
        range(sent[0]["frame_index"], sent[0]["frame_index"] + 30)
    )
    assert all(item["brake"] for item in commands[30:]) and len(commands) > 40
    speeds = [item["sent"]["speed_ms"] for item in sent]
    np.testing.assert_allclose(np.diff(speeds[:10]), 0.1, atol=1e-9)
    assert speeds[-1] == 1.0 and sent[0]["asked"]["speed_ms"] == 1.0
    frames, poses = messages(path, "/camera/image"), messages(path, "/vehicle/pose")
    assert len(frames) in (29, 30, 31)
    assert abs(len(poses) - 50 * 4) < 5  # and while it comes to rest
    assert len(messages(path, "/ages")) == 30
    assert {"speed_ms", "has_timed_out"} < set(messages(path, "/motor")[0])


@pytest.mark.parametrize(
    ("at_first", "changes", "message"),
    [
        # as by a stuck button
        ({"held": True}, [(3.0, "held", False), (3.5, "held", True)], None),
        (
            {"killed": True},
            [
                (1.0, "held", True),
                (2.0, "killed", False),
                (3.0, "held", False),
                (4.0, "held", True),
            ],
            "kill switch",
        ),
        (
            {"offset_m": 5.0},
            [
                (1.0, "held", True),
                (2.0, "offset_m", 0.0),
                (3.0, "held", False),
                (4.0, "held", True),
            ],
            "outside the fence: the car is at x",
        ),
    ],
)
def test_nothing_moves_before_the_enable_is_pressed_anew(
    tmp_path, at_first, changes, message
):
    bench, path = Bench(), tmp_path / "drive.mcap"
    vars(bench).update(at_first)
    for time_s, name, value in changes:
        bench.at(time_s, partial(setattr, bench, name, value))
    bench.drive(path, duration_s=1.0)
    assert bench.events[0][1] == "send"
    assert bench.events[0][0] >= bench.start_s + changes[-1][0]
    told = [item["message"] for item in messages(path, "/safety")]
    assert message is None or any(message in text for text in told)
    assert "ready: release the enable button, then hold it" in told


@pytest.mark.parametrize("rate", [10, 30, 60])
def test_frames_go_to_the_pilot_at_the_period_of_control(tmp_path, rate, monkeypatch):
    bench = Bench()
    taken = bench.index

    def index(device, latency, period):
        return taken(device, latency, 1 / rate if device == "camera" else period)

    monkeypatch.setattr(bench, "index", index)
    from helpers import driving_stand_ins as stand_ins

    newest = stand_ins.StandInCamera.newest

    def at_rate(self):
        frame = newest(self)
        time = bench.start_s + frame.index / rate
        return type(frame)(frame.image, time, frame.index)

    monkeypatch.setattr(stand_ins.StandInCamera, "newest", at_rate)
    bench.at(HOLD_S, partial(setattr, bench, "held", True))
    _, loop = bench.drive(tmp_path / "drive.mcap", duration_s=5.0)
    frames = np.array(loop.measures.rows)[:, 1]
    assert np.mean(np.diff(frames)) == pytest.approx(SETTINGS.judge.period_s, rel=0.03)
    assert np.diff(frames).max() < 0.135
