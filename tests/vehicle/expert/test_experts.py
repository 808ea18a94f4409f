"""Experts keep their lanes in every environment, and what they answer is known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from support.faults.refusals import refusals

from mi_nerfattack.deploy.mujoco.vehicle import MujocoVehicle
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.registry import kinematic_vehicle
from mi_nerfattack.deploy.vehicle import KinematicVehicle, Motion
from mi_nerfattack.vehicle import Route, load_routes
from mi_nerfattack.vehicle.bicycle import RateLimitedAckermann
from mi_nerfattack.vehicle.expert import (
    LaneFollower,
    SteeringFollower,
    expert_for,
    future_positions,
)

pytestmark = pytest.mark.usefixtures("variant")

LIMIT_M = 0.1
LAG_S = 0.15  # of real wheels: of the column and the servo
#: Starts of recoveries, which head away: metres to the left, and radians.
STARTS = [(side * 0.5, side * np.radians(10)) for side in (1, -1)]
STRAIGHT = Route("straight", 0, [[0, 0], [50, 0], [100, 0]], speed_ms=5.0)


def circle(radius=2.0, speed=1.0, side=1):
    angle = side * 2 * np.pi * np.arange(360) / 360
    points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Route("circle", 0, points, 0.6, speed, closed=True)


def follow(vehicle, expert, route, period, start=(0.0, 0.0), laps=2) -> np.ndarray:
    """Drive to the route's end, or around; return the cross-track errors (steps,)."""
    vehicle.reset(route.pose_at(0.0, *start), route.speed_ms)
    states = []
    length = laps * route.length if route.closed else route.length
    for _ in range(int(length / (route.speed_ms * period))):
        vehicle.advance(float(expert.control(vehicle.state)[0]))
        states.append(vehicle.state)
    return route.cross_track_numpy(np.array(states))


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("intersection", "kinematic"),
        ("intersection", "mujoco"),
        ("room", "kinematic"),
        ("room", "rate-limited steering"),
        ("room", "mujoco"),
    ],
)
def test_expert_keeps_the_lane_and_recovers(name, kind):
    """With the vehicle's own lag, and with 0.1 s, in every environment."""
    place = bundled_place(name)
    car, period = place.car, place.period
    lag_s = 0.0 if kind == "kinematic" else LAG_S
    if kind == "mujoco":
        vehicle = MujocoVehicle(car, period=period)
    elif kind == "kinematic":
        vehicle = kinematic_vehicle(place)
    else:
        model = RateLimitedAckermann(5.0, car.wheelbase, car.max_control, 1.5)
        motion = Motion(model, substeps=2)
        vehicle = KinematicVehicle(motion, period, car.max_control, "rad")
    limits = period, vehicle.max_control, car.wheelbase
    for route, lag in itertools.product(load_routes(place.routes), (lag_s, 0.1)):
        expert = expert_for(vehicle.control_unit, route, *limits, lag)
        errors = follow(vehicle, expert, route, period)
        assert len(errors) * period * route.speed_ms > 0.9 * route.length
        starts = [follow(vehicle, expert, route, period, at, 1) for at in STARTS]
        assert min(abs(errors[0]) for errors in starts) > 0.2
        late = max(np.abs(errors[round(5.0 / period) - 2 :]).max() for errors in starts)
        most = np.abs(errors).max()
        print(f"{kind}, {route.name}, lag {lag} s: {most:.3f} m, then {late:.3f} m")
        assert most < LIMIT_M and late < LIMIT_M


def made(unit="rad/s", period=0.1, **options):
    return lambda: expert_for(unit, STRAIGHT, period, **options)


test_unusable_numbers = refusals(
    (made("deg"), "'deg'; .*'rad/s' or 'rad'"),
    (made(period=0.0), "period: 0.0"),
    (made(max_control=-1.0), "max_control: -1.0"),
    (made("rad", max_control=1.6), "below pi/2"),
    (made(wheelbase=float("nan")), "wheelbase: nan"),
    (made(lag=-0.1), "lag: -0.1"),
)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("unit", ["rad/s", "rad"])
def test_feed_forward_on_a_circle(side, unit):
    """On a circle without errors the answer is that of the vehicle's model."""
    radius, speed, wheelbase = 2.0, 1.0, 0.325
    route = circle(radius, speed, side)
    states = np.array([[radius, 0.0, side * np.pi / 2], [0, radius, np.pi / 2]])
    states[1, 2] += side * np.pi / 2
    kind = {"rad/s": LaneFollower, "rad": SteeringFollower}[unit]
    assert all(
        isinstance(expert_for(unit, r, 0.1, 0.4), kind) for r in (STRAIGHT, route)
    )
    expected = {"rad/s": speed / radius, "rad": np.arctan(wheelbase / radius)}[unit]
    controls = expert_for(unit, route, 0.1, 1.5, wheelbase).control(states)
    np.testing.assert_allclose(controls, side * expected, rtol=2e-3)


def test_steering_of_the_lane_follower():
    """Beside a straight: pure pursuit's curvature, as an angle, limited."""
    wheelbase, speed = 2.7, 5.0
    states = [[10, 0.3, 0.05], [20, -0.2, 0.0], [30, 40.0, 0.0]]
    rates = expert_for("rad/s", STRAIGHT, 0.1, 1.5).control(states)
    angles = expert_for("rad", STRAIGHT, 0.1, 0.6, wheelbase).control(states)
    d = 0.55 * speed
    curvature = -0.3 / d**2 - 2 * np.sin(0.05) / d
    np.testing.assert_allclose(rates[0], speed * curvature)
    np.testing.assert_allclose(rates[2], -1.5)
    np.testing.assert_allclose(angles[:2], np.arctan(wheelbase * rates[:2] / speed))
    assert angles[2] == -0.6


@pytest.mark.parametrize("unit", ["rad/s", "rad"])
def test_future_positions_are_those_of_small_steps(unit):
    """Heun's method with 0.1 ms; the control is held for a period of 0.1 s."""
    route, speed, wheelbase, period = circle(12.0, 5.0), 5.0, 2.5, 0.1
    expert = expert_for(unit, route, period, 0.6, wheelbase)
    lateral, heading = np.array([0.0, 1.2, -0.8]), np.array([0.0, 0.3, -0.2])
    poses = route.pose_at(np.array([3.0, 40.0, 75.0]), lateral, heading)
    times = (0.07, 0.5, 1.0, 1.25)
    predicted = future_positions(
        expert, poses, times, speed=speed, period=period, wheelbase=wheelbase
    )
    assert predicted.shape == (3, 4, 2)

    ratio = speed / wheelbase
    for pose, positions in zip(poses, predicted, strict=True):
        x, y, theta = pose
        path, small, rate = [], 1e-4, 0.0
        for step in range(12_501):
            path.append((x, y))
            if step % 1000 == 0:
                (control,) = expert.control(np.array([x, y, theta]))
                rate = ratio * np.tan(control) if unit == "rad" else control
            after = theta + small * rate
            x += small * speed * (np.cos(theta) + np.cos(after)) / 2
            y += small * speed * (np.sin(theta) + np.sin(after)) / 2
            theta = after
        offset = np.array(path)[[700, 5000, 10_000, 12_500]] - pose[:2]
        ahead = np.array([np.cos(pose[2]), np.sin(pose[2])])
        left = np.array([-ahead[1], ahead[0]])
        expected = np.stack([offset @ ahead, offset @ left], axis=1)
        np.testing.assert_allclose(positions, expected, atol=1e-6)
