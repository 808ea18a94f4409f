"""Limits, fence, watchdog and pilots, each alone."""

from __future__ import annotations

import math
import sys
import threading
import time

import numpy as np
import pytest
from helpers.driving_stand_ins import RADIUS, SPEED, Bench, StandInTracker
from helpers.waiting import wait_for
from hypothesis import given
from hypothesis import strategies as st

from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.vehicle import planar_body
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.robot.devices import Command, DeviceLostError, Frame, TrackedPose
from mi_nerfattack.robot.drive.pilot import LocalPilot, expert_control
from mi_nerfattack.robot.drive.safety.fence import Fence, car_corners
from mi_nerfattack.robot.drive.safety.judge import Ages, Judge, Stop
from mi_nerfattack.robot.drive.safety.limits import Limits, Steering
from mi_nerfattack.robot.drive.safety.watchdog import Watchdog, suspended_clock
from mi_nerfattack.vehicle.expert.choose import expert_for
from mi_nerfattack.vehicle.route.route import Route

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
        Limits(speed_ms=0.0)


def test_a_heading_rate_becomes_the_angle_that_turns_so_fast():
    angle = Steering("rad/s", 0.325).angle(1.2, 0.8)
    assert 0.8 / 0.325 * math.tan(angle) == pytest.approx(1.2)
    assert Steering("rad", 0.325).angle(0.3, 0.8) == 0.3


def test_a_concave_fence_holds_what_is_inside():
    fence = Fence(np.array([(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)], float))
    inside = np.array([(0.5, 0.5), (3.9, 3.0), (0.2, 3.0), (2.0, 0.9)])
    assert fence.holds(inside)
    for outside in [(2.0, 1.1), (-0.1, 0.5), (2.0, 3.0), (5.0, 0.0), (math.nan, 1.0)]:
        assert not fence.holds(np.array([*inside, outside]))


def test_the_fence_is_for_the_outline_of_the_car():
    fence = Fence(np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]))
    reach = SMALL_CAR.wheelbase + 0.5 * (SMALL_CAR.length - SMALL_CAR.wheelbase)
    for forward, is_held in ((1 - reach - 0.01, True), (1 - reach + 0.01, False)):
        corners = car_corners(SMALL_CAR, planar_body(np.array([forward, 0.0, 0.0])))
        assert fence.encloses(corners) == is_held
    turned = car_corners(SMALL_CAR, planar_body(np.array([0.0, 0.0, math.pi / 2])))
    np.testing.assert_allclose(turned[:, 1].max(), reach)


@pytest.mark.parametrize(
    "spike",
    [
        [(-0.05, 2.0), (0.0, 0.05), (0.05, 2.0)],  # its tip is inside the car
        [(-0.05, 2.0), (0.0, -1.5), (0.05, 2.0)],  # beyond it
    ],
)
@pytest.mark.parametrize("turn", [0.0, 1.1, -2.5])
def test_a_fence_does_not_reach_into_the_car(spike, turn):
    square = [(-2.0, 2.0), (-2.0, -2.0), (2.0, -2.0), (2.0, 2.0)]
    body = planar_body(np.array([0.3, -0.2, turn]))

    def placed(points) -> np.ndarray:
        middle = np.array([0.5 * SMALL_CAR.wheelbase, 0.0])
        return (np.array(points) + middle) @ body[:2, :2].T + body[:2, 3]

    corners = car_corners(SMALL_CAR, body)
    fence = Fence(placed([*square, *reversed(spike)]))
    assert fence.holds(corners) and not fence.encloses(corners)
    assert Fence(placed(square)).encloses(corners)
    pose = TrackedPose(body, 0.0, 0)
    judge = Judge(Ages(), fence, SMALL_CAR, 0.8, 0.1)
    with pytest.raises(Stop, match="outside the fence: the car is at x 0.30 m"):
        judge.pose(pose, 0.0, StandInTracker(Bench()), "car")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("points_m = [[0, 0], [1, 0]]", "at least 3 corners"),
        ("points_m = [[0, 0], [1, 0], [2, 0]]", "must enclose an area"),
        ("points_m = [[0, 0], [3, 1], [1, 0], [0, 2]]", "sides cross"),
        ("points_m = [[0, 0], [inf, 0], [1, 1]]", "must be finite"),
        ("points_m = 'x'", "needs corners"),
        ("points = [[0, 0], [1, 0], [1, 1]]", "needs points_m alone"),
    ],
)
def test_files_that_are_no_fence(tmp_path, text, message):
    files.write_text(tmp_path / "fence.toml", text)
    with pytest.raises(InputError, match=f"fence.toml: .*{message}"):
        Fence.from_file(tmp_path / "fence.toml")


def test_a_fence_around_a_route():
    points = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0)])
    fence = Fence.around(Route("r", 0, points), 0.5)
    assert fence.holds(np.array([(-0.4, -0.4), (2.4, 1.4)]))
    assert not fence.holds(np.array([(-0.6, 0.0)]))


def test_the_watchdog_brakes_from_its_own_thread_as_long_as_the_loop_hangs():
    braked, calls = threading.Event(), []

    def brake() -> None:
        calls.append(threading.get_ident())
        if len(calls) == 1:
            raise DeviceLostError("once")
        braked.set()

    now = [0.0]
    watchdog = Watchdog(brake, 0.2, lambda: now[0])
    watchdog.start()
    now[0] = 10.0  # nothing drives yet
    watchdog.check()
    assert not calls
    watchdog.beat()
    now[0] += 0.21
    assert braked.wait(10) and watchdog.has_fired
    assert threading.get_ident() not in calls
    watchdog.close()
    watchdog.close()


def test_no_command_goes_out_once_the_watchdog_has_braked():
    now, sent = [0.0], []
    watchdog = Watchdog(lambda: sent.append("brake"), 0.2, lambda: now[0])
    watchdog.beat()
    now[0] = 0.2
    watchdog.permit(lambda: sent.append("send"))
    now[0] = 0.21
    for _ in range(2):
        with pytest.raises(Stop, match=r"loop late: took 0\.210 s, at most 0\.2 s"):
            watchdog.permit(lambda: sent.append("late"))
        watchdog.check()
    watchdog.beat()  # too late
    with pytest.raises(Stop, match="loop late"):
        watchdog.permit(lambda: sent.append("late"))
    assert sent == ["send", "brake", "brake"]


def test_the_watchdog_brakes_behind_a_command_but_for_one_that_hangs():
    now, sent = [0.0], []
    braked = threading.Event()

    def brake() -> None:
        sent.append("brake")
        braked.set()

    def hang() -> None:
        now[0] = 0.21
        assert braked.wait(10)  # though this one does not come back
        sent.append("hung")

    watchdog = Watchdog(brake, 0.2, lambda: now[0])
    watchdog.beat()
    watchdog.start()
    watchdog.permit(hang)
    count = len(sent)
    wait_for(lambda: len(sent) > count)  # and braked after it
    watchdog.close()
    assert sent[0] == "brake" and sent[-1] == "brake" and "hung" in sent


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell")
def test_the_clock_of_rounds_goes_on_while_the_computer_is_suspended(monkeypatch):
    clocks = {time.CLOCK_BOOTTIME: 7200.0, time.CLOCK_MONOTONIC: 3600.0}
    monkeypatch.setattr(time, "clock_gettime", clocks.__getitem__)
    assert suspended_clock() == 7200.0


def frame(index: int) -> Frame:
    return Frame(np.full((2, 2, 3), index, np.uint8), 0.1 * index, index)


def test_a_pilot_decides_of_the_newest_frame():
    begun, go = threading.Event(), threading.Event()

    def control(frame):
        begun.set()
        assert go.wait(10)
        return 0.01 * float(frame.image[0, 0, 0])

    pilot = LocalPilot(control, lambda: 7.0)
    assert pilot.newest() is None
    pilot.submit(frame(1))
    assert begun.wait(10)
    pilot.submit(frame(2))  # replaced before it is begun with
    pilot.submit(frame(3))
    assert pilot.newest() is None  # it hangs, and nobody waits
    go.set()
    wait_for(lambda: (d := pilot.newest()) is not None and d.frame_index == 3)
    decision = pilot.newest()
    assert decision is not None
    assert (decision.control, decision.frame_time_s) == pytest.approx((0.03, 0.3))
    assert decision.time_s == 7.0
    pilot.close()


def test_a_pilot_that_fails_is_lost():
    def control(frame):
        raise ValueError("wrong size")

    pilot = LocalPilot(control, time.monotonic)
    pilot.submit(frame(1))

    def is_lost() -> bool:
        try:
            pilot.newest()
        except DeviceLostError as error:
            return "policy: failed (ValueError: wrong size)" in str(error)
        return False

    wait_for(is_lost)
    with pytest.raises(DeviceLostError):
        pilot.submit(frame(2))
    pilot.close()


def test_the_expert_decides_by_the_tracked_pose():
    angles = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = RADIUS * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    route = Route("ring", 0, ring, 0.6, SPEED, closed=True)
    expert = expert_for("rad", route, 0.1, 0.4, SMALL_CAR.wheelbase, lag=0.0)
    bench = Bench()
    bench.sleep(1.0)
    control = expert_control(expert, StandInTracker(bench), "car")
    # on the circle: the angle that keeps it there
    circle = math.atan(SMALL_CAR.wheelbase / RADIUS)
    assert control(frame(10)) == pytest.approx(circle, abs=0.01)
