"""Experts keep their lanes in every environment, and what they answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from bench.driving import experts
from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle import Route, load_routes
from mi_nerfattack.vehicle.expert import (
    LaneFollower,
    PIDExpert,
    SteeringFollower,
    expert_for,
)

pytestmark = pytest.mark.usefixtures("variant")

STRAIGHT = Route("straight", 0, [[0, 0], [50, 0], [100, 0]], speed_ms=5.0)


def circle(radius=2.0, speed=1.0, side=1):
    angle = side * 2 * np.pi * np.arange(360) / 360
    points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Route("circle", 0, points, 0.6, speed, closed=True)


@pytest.fixture(scope="module")
def cases():
    """Make the vehicles of both bundled places once."""
    return list(experts.cases())


ENVIRONMENTS = [
    ("surrogate, mitsuba", ["straight", "right", "left"]),
    ("mujoco", ["straight", "right", "left"]),
    ("mitsuba", ["square"]),
    ("rate-limited steering", ["square"]),
    ("mujoco", ["square"]),
]


@pytest.mark.parametrize("index", range(5))
def test_expert_keeps_the_lane_and_recovers(index, cases):
    case, (environment, names) = cases[index], ENVIRONMENTS[index]
    period = case.place.period
    assert case.environment == environment
    routes = load_routes(case.place.routes)
    assert [route.name for route in routes] == names
    for route in routes:
        expert = case.expert(route, case.lag_s)
        errors = experts.follow(case.vehicle, expert, route, period)
        assert len(errors) * period * route.speed_ms > 0.9 * route.length
        assert np.abs(errors).max() < 0.1
    for start in experts.STARTS[::3]:
        errors = experts.follow(case.vehicle, expert, route, period, start, laps=1)
        assert abs(errors[0]) > 0.2
        assert experts.recovered(errors, period) < 5.0


@pytest.mark.parametrize("index", [0, 1])
def test_labels_suit_cars_with_and_without_lag(index, cases):
    """One expert drives both: the tightest bend, and wide starts."""
    case = cases[index]
    route = Route.from_file(case.place.routes, "right")
    expert = expert_for("rad/s", route, 0.1)
    errors = experts.follow(case.vehicle, expert, route, 0.1)
    assert np.abs(errors).max() < 0.1
    errors = experts.follow(case.vehicle, expert, route, 0.1, (1.5, 0.4))
    assert np.abs(errors[-10:]).max() < 0.05


def test_time_of_recovery():
    period = 0.5
    assert experts.recovered(np.array([0.05, -0.02]), period) == 0.0
    assert experts.recovered(np.array([0.3, -0.2, 0.05]), period) == 1.5
    assert experts.recovered(np.array([0.3, 0.05, 0.2]), period) == np.inf


def test_choice_of_the_expert():
    loop = circle()
    assert isinstance(expert_for("rad/s", STRAIGHT, 0.1), LaneFollower)
    assert isinstance(expert_for("rad/s", loop, 0.1), LaneFollower)
    assert isinstance(expert_for("rad", STRAIGHT, 0.1, 0.6), SteeringFollower)
    assert isinstance(expert_for("rad", loop, 0.1, 0.4, 0.325), PIDExpert)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control_unit": "deg"}, "'deg'; must be 'rad/s' or 'rad'"),
        ({"period": 0.0}, "period: 0.0"),
        ({"max_control": -1.0}, "max_control: -1.0"),
        ({"control_unit": "rad", "max_control": 1.6}, "below pi/2"),
        ({"wheelbase": float("nan")}, "wheelbase: nan"),
        ({"lag": -0.1}, "lag: -0.1"),
    ],
)
def test_unusable_numbers(changes, message):
    with pytest.raises(InputError, match=message):
        expert_for(
            **({"control_unit": "rad/s", "route": STRAIGHT, "period": 0.1} | changes)
        )


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("unit", ["rad/s", "rad"])
def test_feed_forward_on_a_circle(side, unit):
    """On a circle without errors the answer is that of the vehicle's model."""
    radius, speed, wheelbase = 2.0, 1.0, 0.325
    route = circle(radius, speed, side)
    states = np.array([[radius, 0.0, side * np.pi / 2], [0, radius, np.pi / 2]])
    states[1, 2] += side * np.pi / 2
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


def pid(**changes):
    arguments = {"period": 0.1, "wheelbase": 0.325, "max_control": 0.4}
    straight = Route("straight", 0, [[0, 0], [90, 0]], 0.6, 1.0)
    return PIDExpert(straight, look_ahead_m=0.7, **(arguments | changes))


def test_terms_of_the_pid():
    """Each term alone, and the integral's sum of e dt."""
    expert = pid()
    gain = 0.325 / 0.49
    first = expert.control([[1, 0.1, 0.2], [5, 0.1, 0.0], [5, 0.0, 0.2]])
    expected = [-0.1 * gain - 1.4 * gain * np.sin(0.2), -0.1 * gain]
    expected.append(-1.4 * gain * np.sin(0.2))
    np.testing.assert_allclose(first, expected)
    second = expert.control([[1, 0.0, 0.0]] * 3)
    np.testing.assert_allclose(second, np.array([-0.01, -0.01, 0]) * gain / 5)
    expert.reset()
    np.testing.assert_allclose(expert.control([2, 0.0, 0.0]), [0.0])


def test_integral_does_not_wind_up():
    """Neither where the angle is at its limit, nor during a wide recovery."""
    expert = pid(max_control=0.05)
    for _ in range(100):
        assert expert.control([1, 0.1, 0.0]) == -0.05
    np.testing.assert_allclose(expert.control([1, 0.0, 0.0]), 0.0)
    expert = pid()
    for _ in range(100):
        expert.control([1, 0.2, 0.0])
    np.testing.assert_allclose(expert.control([1, 0.0, 0.0]), 0.0)


def test_integral_removes_a_bent_steering_rod():
    """Bicycle whose wheels stand 3 degrees beside the command, by Euler steps."""
    straight = pid().route
    errors = {}
    for time in (5.0, 1e9):
        expert, state = pid(integral_time=time), np.zeros(3)
        for _ in range(600):
            angle = expert.control(state)[0] + np.radians(3)
            rate = np.tan(angle) / 0.325
            state = state + 0.1 * np.array([np.cos(state[2]), np.sin(state[2]), rate])
        errors[time] = abs(straight.cross_track_numpy(state)[0])
    assert errors[1e9] == pytest.approx(np.radians(3) * 0.49 / 0.325, rel=0.05)
    assert errors[5.0] < 1e-3


def test_pid_wants_a_reset_before_other_vehicles():
    expert = pid()
    expert.control(np.zeros((3, 3)))
    with pytest.raises(InputError, match="2 states after 3; call reset"):
        expert.control(np.zeros((2, 3)))
    expert.reset()
    assert expert.control(np.zeros((2, 5))).shape == (2,)
