"""The simulated room: its car by analysis, and drives of the expert in it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.devices.car import LIMITS, WALL_NS
from support.worlds.places import BlankView

from mi_nerfattack.car.devices import Command, DeviceLostError, MotorValues, TrackedPose
from mi_nerfattack.car.drive.log import DriveLog
from mi_nerfattack.car.drive.loop import Devices, DriveLoop, DriveSettings
from mi_nerfattack.car.drive.pilot import expert_control
from mi_nerfattack.car.drive.safety.fence import Fence
from mi_nerfattack.car.drive.safety.judge import Ages, Cause, Judge
from mi_nerfattack.car.drive.safety.limits import Steering
from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.errors import InputError
from mi_nerfattack.props import rehearsal
from mi_nerfattack.render.camera.intrinsics import (
    CameraMount,
    mount_matrix,
    planar_body,
)
from mi_nerfattack.vehicle.expert.choose import expert_for
from mi_nerfattack.vehicle.route.route import Route


def route() -> Route:
    return Route.from_file(bundled_place("room").routes, "square")


def test_the_car_drives_a_circle_and_stops_when_nobody_commands_it():
    room = rehearsal.SimulatedRoom(SMALL_CAR, np.zeros(3))
    motor = rehearsal.SimulatedMotor(room)
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


class Person(rehearsal.SimulatedEnable):
    """Holds the button after so many seconds."""

    def __init__(self, room: rehearsal.SimulatedRoom, after_s: float) -> None:
        self._room, self._after_s = room, after_s

    def is_held(self) -> bool:
        return self._room.now_s >= self._after_s


class WronglyScaledMotor(rehearsal.SimulatedMotor):
    """Drives faster than commanded by a factor, of which its own turns tell nothing."""

    def __init__(self, room: rehearsal.SimulatedRoom, factor: float) -> None:
        super().__init__(room)
        self._factor = factor

    def send(self, command: Command) -> Command:
        super().send(replace(command, speed_ms=self._factor * command.speed_ms))
        return command

    def read(self) -> MotorValues:
        values = super().read()
        assert values.speed_ms is not None
        return replace(values, speed_ms=values.speed_ms / self._factor)


def drive(path, camera, room, duration_s: float, after_s=1.0, factor=1.0):
    tracker, motor = rehearsal.SimulatedTracker(room), WronglyScaledMotor(room, factor)
    line = route()
    expert = expert_for("rad", line, 0.1, 0.4, SMALL_CAR.wheelbase, lag=0.05)
    pilot = rehearsal.SimulatedPilot(
        lambda: expert_control(expert, tracker, "car"), room
    )
    judge = Judge(Ages(), Fence.around(line, 0.5), SMALL_CAR, 0.8, 0.1)
    steering = Steering("rad", SMALL_CAR.wheelbase)
    settings = DriveSettings("car", 1.0, judge, LIMITS, steering, duration_s)
    log = DriveLog(path, camera.camera, room.clock, WALL_NS, {})
    motor.arm()
    devices = Devices(camera, tracker, motor, pilot, Person(room, after_s))
    times = room.clock, room.clock, room.sleep
    loop = DriveLoop(devices, settings, log, *times, lambda text: None)
    stop = loop.run(lambda: None)
    log.close()
    assert stop.cause is Cause.TIME_UP or factor != 1.0, stop
    figures = loop.measures.figures(line)
    assert figures is not None
    return figures, log.counts


def blank_camera(room: rehearsal.SimulatedRoom) -> rehearsal.RenderedCamera:
    return rehearsal.RenderedCamera(
        BlankView(), CameraMount(), lambda: room.pose_before(0.03, 0.005), room.clock
    )


def test_how_long_the_car_stood_does_not_change_its_drive(tmp_path, variant):
    room = rehearsal.SimulatedRoom(SMALL_CAR, route().pose_at(0.0, 0.1))
    figures, _ = drive(tmp_path / "a.mcap", blank_camera(room), room, 8.0, after_s=20.0)
    assert figures.largest_error_m < 0.102  # where it was put down
    assert figures.mean_error_m < 0.03


@pytest.mark.parametrize("factor", [1.5, 2.0, 3.0])
def test_a_car_that_is_faster_than_commanded_is_braked(tmp_path, variant, factor):
    """Of 1 m/s: it drives at more than 1.3 m/s for at most 0.3 s."""
    room, speeds = rehearsal.SimulatedRoom(SMALL_CAR, route().pose_at(0.0)), []
    sleep = room.sleep

    def watched(seconds: float) -> None:
        for _ in range(round(seconds / 0.005)):
            sleep(0.005)
            speeds.append(room.speed_ms)

    room.sleep = watched
    drive(tmp_path / "a.mcap", blank_camera(room), room, 6.0, factor=factor)
    above_s = 0.005 * sum(speed > 1.3 for speed in speeds)
    assert 0.3 < max(speeds) < 1.6 and above_s <= 0.3 and room.speed_ms == 0.0


def test_the_expert_drives_the_square(tmp_path, variant):
    room = rehearsal.SimulatedRoom(SMALL_CAR, route().pose_at(0.0))
    figures, counts = drive(tmp_path / "drive.mcap", blank_camera(room), room, 30.0)
    assert figures.laps == pytest.approx(29.5 / route().length, abs=0.05)
    assert figures.largest_error_m < 0.06 and figures.commands == 299
    assert figures.period_s == pytest.approx(0.1, abs=1e-3)
    assert 0.05 < figures.latency_median_s < 0.08
    assert counts["/ages"] == 299 < counts["/command"]
    recording = open_recording(tmp_path / "drive.mcap", None, CameraMount())
    assert len(recording.track.times) == 300


class NotingView(BlankView):
    """A view that notes from where it was asked to render, and that it was closed."""

    def __init__(self) -> None:
        super().__init__()
        self.places: list[np.ndarray] = []
        self.closed = 0

    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        self.places.append(camera_to_world)
        return super().render(camera_to_world, seed)

    def close(self) -> None:
        self.closed += 1


class Car:
    """A car on a circle, by a clock that is moved by hand."""

    def __init__(self) -> None:
        self.time_s, self.is_seen = 100.0, True

    def state(self) -> np.ndarray:
        angle = self.time_s
        return np.array([3 * np.cos(angle), 3 * np.sin(angle), angle + np.pi / 2])

    def pose(self) -> TrackedPose | None:
        body = planar_body(self.state())
        return TrackedPose(body, self.time_s, 0) if self.is_seen else None


def test_images_come_in_step_with_the_clock():
    car, view, mount = Car(), NotingView(), CameraMount(0.2, 0.1, 10.0)
    camera = rehearsal.RenderedCamera(
        view, mount, car.pose, lambda: car.time_s, seed=(1 << 32) - 2
    )
    assert camera.camera is view.camera
    states, frames = [], []
    for step in range(60):  # at 50 Hz
        frame = camera.newest()
        assert frame is not None
        if frame.index != (frames[-1].index if frames else -1):
            frames.append(frame)
            states.append(car.state())
            assert frame.time_s == car.time_s
        assert frame is frames[-1] and frame.index == step // 5
        car.time_s += 0.02
    assert len(frames) == 12 and frames[0].image.shape == (2, 4, 3)
    expected = mount_matrix(np.array(states), mount)
    assert np.array(view.places) == pytest.approx(expected, abs=1e-9)
    assert view.seeds == [*range((1 << 32) - 2, 1 << 32), *range(10)]


def test_images_that_nobody_asked_for_are_counted():
    car, view = Car(), NotingView()
    camera = rehearsal.RenderedCamera(view, CameraMount(), car.pose, lambda: car.time_s)
    car.is_seen = False
    assert camera.newest() is None
    car.is_seen, car.time_s = True, car.time_s + 0.75
    frame = camera.newest()
    assert frame is not None and frame.index == 7 and len(view.places) == 1
    car.is_seen, car.time_s = False, car.time_s + 1
    assert camera.newest() is frame  # and grows old
    camera.close()
    camera.close()
    assert view.closed == 1
    with pytest.raises(DeviceLostError):
        camera.newest()
    with pytest.raises(InputError, match="period_s: 0"):
        rehearsal.RenderedCamera(view, CameraMount(), car.pose, lambda: 0.0, period_s=0)
