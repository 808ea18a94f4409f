"""The MuJoCo car against the bicycle model, its stated lags and Coulomb's friction."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from support.faults.refusals import refusals

from mi_nerfattack.deploy.car import CAR, SMALL_CAR
from mi_nerfattack.deploy.mujoco import car as mjcf_car
from mi_nerfattack.deploy.mujoco.car import Handling, ackermann_angles
from mi_nerfattack.deploy.mujoco.vehicle import MujocoVehicle, SteeringAngle


def moving(car=CAR, speed=5.0, pose=(0.0, 0.0, 0.0), **options) -> MujocoVehicle:
    vehicle = MujocoVehicle(car, SteeringAngle(car.max_steer), **options)
    vehicle.reset(np.array(pose), speed)
    return vehicle


def turn(vehicle: MujocoVehicle, control: float, count: int) -> np.ndarray:
    """Advance with one control; return the state after each period (count, 6)."""
    states = []
    for _ in range(count):
        vehicle.advance(control)
        states.append(vehicle.state)
    return np.array(states)


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a circle to points (n, 2): centre and radius, least squares (Kasa 1976)."""
    columns = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    solution, *_ = np.linalg.lstsq(columns, (points**2).sum(axis=1), rcond=None)
    centre = solution[:2]
    return centre, math.sqrt(solution[2] + centre @ centre)


def drive_circle(car, steer, speed, share=0.3, **options) -> tuple[float, np.ndarray]:
    """Drive a share of a circle, after 3 s in which the steering settles.

    Returns:
        relative error of the radius against the bicycle model's, l / tan(steer); the
        states (n, 6).
    """
    expected = car.wheelbase / math.tan(abs(steer))
    vehicle = moving(car, speed, **options)
    turn(vehicle, steer, 30)
    count = math.ceil(share * 2 * math.pi * expected / speed / 0.1)
    states = turn(vehicle, steer, count)
    error = fit_circle(states[:, :2])[1] / expected - 1
    print(f"wheelbase {car.wheelbase} m, {steer} rad, {speed} m/s: {error:+.2%}")
    return error, states


@pytest.mark.parametrize(
    ("car", "steer", "speed"),
    [
        (CAR, 0.1, 5.0),
        (CAR, -0.3, 3.0),
        (CAR, 0.5, 5.0),
        (SMALL_CAR, 0.1, 1.5),
        (SMALL_CAR, -0.3, 0.5),
        (SMALL_CAR, 0.3, 1.5),
    ],
)
def test_turn_radius_is_that_of_the_bicycle_model(car, steer, speed):
    error, states = drive_circle(car, steer, speed)
    assert abs(error) < 0.01
    assert states[:, 3].mean() == pytest.approx(speed, rel=0.01)
    rate = speed / car.wheelbase * math.tan(steer)
    assert states[-1, 5] == pytest.approx(rate, rel=0.02)  # and its sign


def test_a_state_may_refer_to_a_point_ahead_of_the_rear_axle():
    ahead, heading = CAR.wheelbase / 2, 0.7
    # The mass stands at this point, too, which is between the axles here
    twin = moving(CAR, pose=(1.0, 2.0, heading))
    forward = ahead * np.array([math.cos(heading), math.sin(heading)])
    pose = (*(np.array([1.0, 2.0]) + forward), heading)
    vehicle = moving(replace(CAR, reference=ahead), pose=pose)
    np.testing.assert_allclose(vehicle.state[:3], pose, atol=1e-12)
    states, expected = turn(vehicle, 0.3, 20), turn(twin, 0.3, 20)
    theta = expected[:, 2]
    expected[:, :2] += ahead * np.stack([np.cos(theta), np.sin(theta)], axis=1)
    np.testing.assert_allclose(states, expected, atol=1e-4)  # it pitches and rolls
    np.testing.assert_allclose(vehicle.body_to_world[:2, 3], states[-1, :2])


def test_heading_rate_becomes_a_steering_angle():
    vehicle, small = MujocoVehicle(CAR), MujocoVehicle(SMALL_CAR)
    assert (vehicle.control_unit, small.control_unit) == ("rad/s", "rad")
    vehicle.reset(np.array([1.0, 2.0, 0.5]), 5.0)
    assert vehicle.state[2] == 0.5
    settled = turn(vehicle, 0.6, 40)[-1]
    assert settled[4] == pytest.approx(math.atan(2.7 * 0.6 / 5.0), rel=1e-2)
    assert settled[5] == pytest.approx(0.6, rel=0.02)
    end = turn(vehicle, 0.6, 30)[-1, 2]
    assert end - settled[2] == pytest.approx(0.6 * 3.0, rel=0.02)
    assert end > math.pi  # not wrapped


@pytest.mark.parametrize(("car", "speed"), [(CAR, 5.0), (SMALL_CAR, 1.0)])
def test_straight_stays_straight_and_level(car, speed):
    """From the first millisecond on: a reset starts without a jump."""
    heading = 0.7
    vehicle = moving(car, speed, (3.0, -2.0, heading), period=mjcf_car.MAX_TIMESTEP)
    states, heights = [], []
    for _ in range(round(10 / speed / mjcf_car.MAX_TIMESTEP)):
        vehicle.advance(0.0)
        states.append(vehicle.state)
        heights.append(vehicle.body_to_world[2, 3])
    assert np.ptp(heights[:100]) < 1e-5 * car.wheelbase
    assert abs(heights[-1]) < 1e-4 * car.wheelbase
    x, y, theta, driven, steer, rate = np.transpose(states)
    np.testing.assert_allclose(driven, speed, rtol=2e-3)
    assert driven[-1] == pytest.approx(speed, rel=1e-3)
    along = (x - 3) * math.cos(heading) + (y + 2) * math.sin(heading)
    across = (y + 2) * math.cos(heading) - (x - 3) * math.sin(heading)
    assert along[99] == pytest.approx(100 * mjcf_car.MAX_TIMESTEP * speed, rel=1e-3)
    assert np.abs(across).max() < 1e-3
    assert along[-1] == pytest.approx(10.0, abs=0.01)
    assert np.abs([theta - heading, rate]).max() < 1e-4 and np.abs(steer).max() < 1e-5
    matrix = vehicle.body_to_world
    np.testing.assert_allclose(matrix[:2, 3], (x[-1], y[-1]))
    assert matrix[2, 2] > 1 - 1e-8  # no pitch, no roll
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("steering", [None, SteeringAngle(CAR.max_steer)])
def test_nothing_of_the_drive_before_and_no_control_beyond_the_limit_counts(steering):
    again, other = MujocoVehicle(CAR, steering), MujocoVehicle(CAR, steering)
    again.reset(np.ones(3), 3.0)
    turn(again, 0.4, 5)
    for vehicle in (again, other):
        vehicle.reset(np.zeros(3), 5.0)
    wild, limited = turn(again, 50.0, 10), turn(other, other.max_control, 10)
    np.testing.assert_array_equal(wild, limited)


@pytest.mark.parametrize("lag", [0.1, 0.3])
def test_steering_follows_with_the_stated_lag(lag):
    vehicle = moving(handling=Handling(steer_time_constant=lag), period=0.02)
    share = turn(vehicle, 0.006, 39)[:, 4] / 0.006
    expected = 1 - np.exp(-0.02 * np.arange(1, 40) / lag)
    # the servo after the lag and the rate limit before it take some milliseconds
    np.testing.assert_allclose(share, expected, rtol=0, atol=0.015 / lag)


def test_steering_rate_is_limited():
    handling = Handling(steer_time_constant=0.01, steer_rate=0.5)
    vehicle = moving(speed=1.0, handling=handling, period=0.02)
    rates = np.diff(turn(vehicle, 0.4, 40)[:, 4]) / 0.02
    assert rates.max() < 0.505
    assert rates[5:30].min() > 0.49


@pytest.mark.parametrize(
    ("car", "speed", "friction"),
    [(CAR, 8.0, 0.2), (CAR, 8.0, 0.5), (CAR, 10.0, None), (SMALL_CAR, 4.0, None)],
)
def test_friction_limits_the_curvature(car, speed, friction):
    """At 0.3 rad each needs more friction than there is; None is the default."""
    handling = Handling() if friction is None else Handling(friction=friction)
    radius, most = car.wheelbase / math.tan(0.3), 9.81 * handling.friction
    assert speed**2 / radius > most
    error, states = drive_circle(car, 0.3, speed, share=0.6, handling=handling)
    # v^2 / R cannot exceed mu g, whatever the wheels are turned to
    assert (1 + error) * radius > 0.9 * states[:, 3].mean() ** 2 / most
    assert error > 0.1


def test_slip_is_small_until_the_car_slides():
    for speed, low, high in ((5.0, 0.0, 0.02), (14.0, 0.5, 20.0)):
        vehicle = moving(speed=speed)
        turn(vehicle, 0.3, 20)
        assert low <= np.abs(vehicle.slip_speeds).max() < high


@pytest.mark.parametrize("car", [CAR, SMALL_CAR], ids=["full", "small"])
def test_wheels_meet_in_one_point(car):
    vehicle = moving(car, 0.1)
    turn(vehicle, 0.9 * car.max_steer, 20)
    expected = ackermann_angles(car, vehicle.state[4])
    for name, angle in zip(mjcf_car.WHEELS[:2], expected, strict=True):
        joint_angle = vehicle._data.joint(f"{name}_steer").qpos[0]
        assert joint_angle == pytest.approx(float(angle), rel=0.01)
    left, right = (car.wheelbase / math.tan(float(angle)) for angle in expected)
    # the axes of both front wheels cross the rear axle's line at the same distance
    assert right - left == pytest.approx(car.track, rel=1e-9)


def test_nothing_of_the_car_touches_itself_and_its_mass_is_right():
    vehicle = moving(speed=1.0)
    turn(vehicle, 0.7, 20)
    model, data = vehicle._model, vehicle._data
    assert data.ncon >= 3
    for contact in data.contact:
        names = {model.geom(int(geom)).name for geom in contact.geom}
        assert mjcf_car.GROUND in names
        assert len(names & set(mjcf_car.WHEELS)) == 1
    column = model.body(mjcf_car.COLUMN).mass[0]
    assert mujoco.mj_getTotalmass(model) - column == pytest.approx(CAR.mass)


def started(pose=(0.0, 0.0, 0.0), speed=5.0, control=0.0):
    def drive():
        vehicle = MujocoVehicle(CAR)
        vehicle.reset(np.array(pose), speed)
        vehicle.advance(control)

    return drive


test_bad_input_is_refused = refusals(
    (lambda: MujocoVehicle(CAR, period=0.0333), "physics timestep"),
    (lambda: MujocoVehicle(CAR, period=0.0), "period"),
    (lambda: MujocoVehicle(replace(CAR, control_unit="other")), "unit: 'other'; a car"),
    (lambda: MujocoVehicle(CAR, timestep=0.01), "timestep: 0.01"),
    # 2.7 m / tan(u) is half the track of 1.55 m at 1.291 rad
    (lambda: MujocoVehicle(replace(CAR, max_steer=1.25)), "car.max_steer: .* 1.241"),
    (lambda: Handling(friction=0.0), "handling.friction"),
    (lambda: SteeringAngle(-1.0), "max_control"),
    (lambda: MujocoVehicle(CAR).advance(0.0), "after reset"),
    (lambda: MujocoVehicle(CAR).state, "after reset"),
    (started(pose=(0.0, math.nan, 0.0)), "pose"),
    (started(speed=math.inf), "speed"),
    (started(control=math.nan), "control: nan"),
)
