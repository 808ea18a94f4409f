"""The MuJoCo car against the bicycle model, its stated lags and Coulomb's friction."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from bench.driving import circle
from mi_nerfattack.deploy.car import CAR, SMALL_CAR
from mi_nerfattack.deploy.mujoco import car as mjcf_car
from mi_nerfattack.deploy.mujoco.car import Handling, ackermann_angles
from mi_nerfattack.deploy.mujoco.vehicle import (
    HeadingRate,
    MujocoVehicle,
    SteeringAngle,
    steering_of,
)
from mi_nerfattack.errors import InputError

CARS = pytest.mark.parametrize("car", [CAR, SMALL_CAR], ids=["full", "small"])


def moving(car=CAR, speed=5.0, pose=(0.0, 0.0, 0.0), **options) -> MujocoVehicle:
    vehicle = MujocoVehicle(car, SteeringAngle(car.max_steer), **options)
    vehicle.reset(np.array(pose), speed)
    return vehicle


@pytest.mark.parametrize("steer", [0.1, -0.3, 0.5])
@pytest.mark.parametrize("speed", [3.0, 5.0])
def test_turn_radius_is_that_of_the_bicycle_model(steer, speed):
    driven = circle.drive_circle(
        circle.Case("full-size car", abs(steer), speed), share=0.3
    )
    assert driven.demand < 0.6
    assert abs(driven.error) < 0.05
    assert driven.speed_ms == pytest.approx(speed, rel=0.01)
    vehicle = moving(speed=speed)
    for _ in range(20):
        vehicle.advance(steer)
    rate = speed / CAR.wheelbase * math.tan(steer)
    assert vehicle.state[5] == pytest.approx(rate, rel=0.02)  # and its sign


@pytest.mark.parametrize("steer", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("speed", [0.5, 1.5])
def test_turn_radius_of_the_small_car(steer, speed):
    driven = circle.drive_circle(circle.Case("small car", steer, speed), share=0.3)
    assert abs(driven.error) < 0.05


def test_heading_rate_becomes_a_steering_angle():
    vehicle = MujocoVehicle(CAR)
    assert vehicle.control_unit == "rad/s"
    vehicle.reset(np.array([1.0, 2.0, 0.5]), 5.0)
    start = vehicle.state
    for _ in range(40):
        vehicle.advance(0.6)
    settled = vehicle.state
    assert settled[4] == pytest.approx(math.atan(2.7 * 0.6 / 5.0), rel=1e-2)
    assert settled[5] == pytest.approx(0.6, rel=0.02)
    for _ in range(30):
        vehicle.advance(0.6)
    turned = vehicle.state[2] - settled[2]
    assert turned == pytest.approx(0.6 * 3.0, rel=0.02)
    assert start[2] == 0.5
    assert vehicle.state[2] > math.pi  # not wrapped


def test_what_a_control_means_follows_from_the_car():
    assert isinstance(steering_of(CAR), HeadingRate)
    assert isinstance(steering_of(SMALL_CAR), SteeringAngle)
    vehicle = MujocoVehicle(SMALL_CAR)
    assert (vehicle.control_unit, vehicle.max_control) == ("rad", SMALL_CAR.max_control)


@CARS
def test_straight_stays_straight_and_level(car):
    speed = 5.0 if car is CAR else 1.0
    heading = 0.7
    vehicle = moving(car, speed, (3.0, -2.0, heading))
    for _ in range(round(10 / speed / 0.1)):
        vehicle.advance(0.0)
    x, y, theta, driven, steer, rate = vehicle.state
    along = (x - 3) * math.cos(heading) + (y + 2) * math.sin(heading)
    across = (y + 2) * math.cos(heading) - (x - 3) * math.sin(heading)
    assert abs(across) < 1e-3
    assert along == pytest.approx(10.0, abs=0.01)
    assert driven == pytest.approx(speed, rel=1e-3)
    assert abs(theta - heading) < 1e-4
    assert abs(steer) < 1e-5
    assert abs(rate) < 1e-4
    matrix = vehicle.body_to_world
    assert abs(matrix[2, 3]) < 1e-4 * car.wheelbase
    np.testing.assert_allclose(matrix[:2, 3], (x, y))
    assert matrix[2, 2] > 1 - 1e-8  # no pitch, no roll
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)


@CARS
def test_reset_starts_without_a_jump(car):
    speed = 5.0 if car is CAR else 1.0
    vehicle = moving(car, speed, period=mjcf_car.MAX_TIMESTEP)
    heights, speeds = [], []
    for _ in range(100):
        vehicle.advance(0.0)
        heights.append(vehicle.body_to_world[2, 3])
        speeds.append(vehicle.state[3])
    assert np.ptp(heights) < 1e-5 * car.wheelbase
    assert np.abs(np.array(speeds) / speed - 1).max() < 2e-3
    assert vehicle.state[0] == pytest.approx(speed * 0.2, rel=1e-3)


def test_another_reset_forgets_the_drive_before():
    vehicle = moving()
    for _ in range(5):
        vehicle.advance(0.4)
    vehicle.reset(np.zeros(3), 5.0)
    other = moving()
    for _ in range(5):
        vehicle.advance(0.1)
        other.advance(0.1)
    np.testing.assert_array_equal(vehicle.state, other.state)


@pytest.mark.parametrize("lag", [0.1, 0.3])
def test_steering_follows_with_the_stated_lag(lag):
    step = 0.006
    handling = Handling(steer_time_constant=lag)
    vehicle = moving(handling=handling, period=0.02)
    for index in range(1, 40):
        vehicle.advance(step)
        expected = 1 - math.exp(-0.02 * index / lag)
        # the servo after the lag and the rate limit before it take some milliseconds
        assert vehicle.state[4] / step == pytest.approx(expected, abs=0.015 / lag)


def test_steering_rate_is_limited():
    handling = Handling(steer_time_constant=0.01, steer_rate=0.5)
    vehicle = moving(speed=1.0, handling=handling, period=0.02)
    angles = []
    for _ in range(40):
        vehicle.advance(0.4)
        angles.append(vehicle.state[4])
    rates = np.diff(angles) / 0.02
    assert rates.max() < 0.505
    assert rates[5:30].min() > 0.49


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_friction_limits_the_curvature(friction):
    handling = Handling(friction=friction)
    case = circle.Case("full-size car", 0.3, 8.0)
    driven = circle.drive_circle(case, handling, share=0.6)
    assert driven.demand > 1
    # v^2 / R cannot exceed mu g, whatever the wheels are turned to
    limit = driven.speed_ms**2 / (9.81 * friction)
    assert driven.radius_m > 0.9 * limit
    assert driven.error > 0.1


def test_slip_is_small_until_the_car_slides():
    gripping, sliding = moving(speed=5.0), moving(speed=14.0)
    for _ in range(20):
        gripping.advance(0.3)
        sliding.advance(0.3)
    assert np.abs(gripping.slip_speeds).max() < 0.02
    assert np.abs(sliding.slip_speeds).max() > 0.5


@CARS
def test_wheels_meet_in_one_point(car):
    steer = 0.9 * car.max_steer
    vehicle = moving(car, 0.1)
    for _ in range(20):
        vehicle.advance(steer)
    data = vehicle._data
    expected = ackermann_angles(car, vehicle.state[4])
    for name, angle in zip(mjcf_car.WHEELS[:2], expected, strict=True):
        found = data.joint(f"{name}_steer").qpos[0]
        assert found == pytest.approx(float(angle), rel=0.01)
    left, right = (car.wheelbase / math.tan(float(angle)) for angle in expected)
    # the axes of both front wheels cross the rear axle's line at the same distance
    assert right - left == pytest.approx(car.track, rel=1e-9)


def test_nothing_of_the_car_touches_itself():
    vehicle = moving(speed=1.0)
    for _ in range(20):
        vehicle.advance(0.7)
    model, data = vehicle._model, vehicle._data
    assert data.ncon >= 3
    for contact in data.contact:
        names = {model.geom(int(geom)).name for geom in contact.geom}
        assert mjcf_car.GROUND in names
        assert len(names & set(mjcf_car.WHEELS)) == 1


def test_control_beyond_the_limit_saturates():
    wild, at_limit = moving(speed=2.0), moving(speed=2.0)
    for _ in range(10):
        wild.advance(50.0)
        at_limit.advance(CAR.max_steer)
    np.testing.assert_array_equal(wild.state, at_limit.state)


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="no multiple of the physics timestep"):
        MujocoVehicle(CAR, period=0.0333)
    with pytest.raises(InputError, match="period"):
        MujocoVehicle(CAR, period=0.0)
    with pytest.raises(InputError, match="timestep: 0.01"):
        MujocoVehicle(CAR, timestep=0.01)
    # 2.7 m / tan(u) is half the track of 1.55 m at 1.291 rad
    with pytest.raises(InputError, match="car.max_steer: 1.25 rad; .* than 1.241 rad"):
        MujocoVehicle(replace(CAR, max_steer=1.25))
    with pytest.raises(InputError, match="handling.friction"):
        Handling(friction=0.0)
    with pytest.raises(InputError, match="max_control"):
        SteeringAngle(-1.0)
    vehicle = MujocoVehicle(CAR)
    with pytest.raises(InputError, match="after reset"):
        vehicle.advance(0.0)
    with pytest.raises(InputError, match="after reset"):
        _ = vehicle.state
    with pytest.raises(InputError, match="pose"):
        vehicle.reset(np.array([0.0, math.nan, 0.0]), 5.0)
    with pytest.raises(InputError, match="speed"):
        vehicle.reset(np.zeros(3), math.inf)
    vehicle.reset(np.zeros(3), 5.0)
    with pytest.raises(InputError, match="control: nan"):
        vehicle.advance(math.nan)


def test_the_mass_is_the_cars():
    model = MujocoVehicle(CAR)._model
    column = model.body(mjcf_car.COLUMN).mass[0]
    assert mujoco.mj_getTotalmass(model) - column == pytest.approx(CAR.mass)
