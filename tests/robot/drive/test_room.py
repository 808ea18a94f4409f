"""The simulated room: its car by analysis, and drives of the expert in it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers.blank_view import BlankView
from helpers.driving_stand_ins import WALL_NS

from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.robot.camera.rendered import RenderedCamera
from mi_nerfattack.robot.devices import Command
from mi_nerfattack.robot.drive.log import DriveLog
from mi_nerfattack.robot.drive.loop import Devices, DriveLoop, DriveSettings
from mi_nerfattack.robot.drive.pilot import expert_control
from mi_nerfattack.robot.drive.room import (
    SimulatedEnable,
    SimulatedMotor,
    SimulatedPilot,
    SimulatedRoom,
    SimulatedTracker,
    simulated_camera,
)
from mi_nerfattack.robot.drive.safety.fence import Fence
from mi_nerfattack.robot.drive.safety.judge import Ages, Cause, Judge
from mi_nerfattack.robot.drive.safety.limits import Limits, Steering
from mi_nerfattack.robot.drive.safety.watchdog import Watchdog
from mi_nerfattack.vehicle.expert.choose import expert_for
from mi_nerfattack.vehicle.route.route import Route


def route() -> Route:
    return Route.from_file(bundled_place("room").routes, "square")


def test_the_car_drives_a_circle_and_stops_when_nobody_commands_it():
    room = SimulatedRoom(SMALL_CAR, np.zeros(3))
    motor = SimulatedMotor(room)
    motor.arm()
    radius = SMALL_CAR.wheelbase / math.tan(0.2)
    for _ in range(60):
        motor.send(Command(1.0, 0.2))
        room.sleep(0.1)
    x, y, heading = room.state
    np.testing.assert_allclose(
        (x, y), radius * np.array([math.sin(heading), 1 - math.cos(heading)]), atol=1e-9
    )
    # 0.25 s at full speed were missing at the start
    assert heading == pytest.approx((6.0 - 0.125) / radius, abs=0.01)
    room.sleep(2.0)
    assert room.has_timed_out and room.speed_ms == 0
    way = (room.state[2] - heading) * radius  # 0.15 s until it brakes, then v^2 / 2a
    assert way == pytest.approx(0.15 + 1 / 6, abs=0.02)


def drive(path, camera, room: SimulatedRoom, duration_s: float):
    tracker, motor, line = SimulatedTracker(room), SimulatedMotor(room), route()
    expert = expert_for("rad", line, 0.1, 0.4, SMALL_CAR.wheelbase, lag=0.05)
    pilot = SimulatedPilot(expert_control(expert, tracker, "car"), room)
    judge = Judge(Ages(), Fence.around(line, 0.5), SMALL_CAR, 0.8, 0.1)
    limits, steering = Limits(), Steering("rad", SMALL_CAR.wheelbase)
    settings = DriveSettings("car", 1.0, judge, limits, steering, duration_s)
    log = DriveLog(path, camera.camera, room.clock, WALL_NS, {})
    motor.arm()
    loop = DriveLoop(
        Devices(camera, tracker, motor, pilot, SimulatedEnable(room)),
        settings,
        log,
        Watchdog(motor.brake, 0.2, room.clock),
        room.clock,
        room.sleep,
        lambda text: None,
    )
    stop = loop.run(lambda: None)
    log.close()
    assert stop.cause is Cause.TIME_UP, stop
    figures = loop.measures.figures(line)
    assert figures is not None
    return figures, log.counts


def test_the_expert_drives_the_square(tmp_path, variant):
    room = SimulatedRoom(SMALL_CAR, route().pose_at(0.0))
    camera = RenderedCamera(
        BlankView(), CameraMount(), lambda: room.pose_before(0.03, 0.005), room.clock
    )
    figures, counts = drive(tmp_path / "drive.mcap", camera, room, 30.0)
    assert figures.laps == pytest.approx(29.5 / route().length, abs=0.05)
    assert figures.largest_error_m < 0.06 and figures.commands == 300
    assert figures.period_s == pytest.approx(0.1, abs=1e-3)
    assert 0.05 < figures.latency_median_s < 0.08
    assert counts["/camera/image"] == 300 == counts["/ages"] < counts["/command"]
    recording = open_recording(tmp_path / "drive.mcap", None, CameraMount())
    assert len(recording.track.times) == 300


@pytest.mark.slow
def test_ten_minutes_in_the_rendered_room(tmp_path, variant):
    place = replace(bundled_place("room"), camera=from_fov(64, 24, 90.0))
    room = SimulatedRoom(SMALL_CAR, route().pose_at(0.0))
    camera = simulated_camera(room, place, spp=1)
    figures, counts = drive(tmp_path / "drive.mcap", camera, room, 600.0)
    print(figures, counts)
    assert figures.laps > 45 and figures.largest_error_m < 0.06
    assert figures.longest_period_s < 0.15 and figures.latency_99_s < 0.1
    reader = pytest.importorskip("mcap.reader")
    with (tmp_path / "drive.mcap").open("rb") as stream:
        topics = (c.topic for _, c, _ in reader.make_reader(stream).iter_messages())
        assert Counter(topics) == counts
    assert counts["/camera/image"] == 6000
