"""Models with a speed state against differences, closed forms and each other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.reference.derivatives import row64, state64

from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.variation import Variation, Varied
from mi_nerfattack.vehicle import (
    RK4,
    AbstractDynamics,
    Ackermann,
    Dubins,
    DynamicSingleTrack,
    ExplicitEuler,
    KinematicBicycle,
    KinematicSingleTrack,
    RateLimitedAckermann,
)
from mi_nerfattack.vehicle.dynamics import require_controls
from mi_nerfattack.vehicle.integrators import Transition
from mi_nerfattack.vehicle.single_track import GRAVITY, longitudinal
from mi_nerfattack.vehicle.user_model import FunctionDynamics

pytestmark = pytest.mark.usefixtures("variant")

ROLLING = KinematicSingleTrack(8.0, 0.6, 3.0, 8.0, wheelbase=2.5)
#: Grip without end, and slip angles as they are.
LINEAR = DynamicSingleTrack(
    12.0, front_m=1.2, rear_m=1.5, rear_stiffness=9e4, friction=1e6, low_speed=1e-3
)
SLIPPING = replace(LINEAR, friction=0.9, low_speed=1.0)
MODELS = [ROLLING, SLIPPING]


def controls64(steering, acceleration):
    return dr.llvm.ad.ArrayXf64(row64(steering), row64(acceleration))


def drive(model, controls, seconds, dt=0.02, start=None, integrator=None):
    """Return the states (steps + 1, m) of a car under constant controls."""
    x = state64(model.extend(np.zeros(3)).T if start is None else start)
    u, path = controls64(*controls), [x.numpy()[:, 0].copy()]
    step = Transition(model, integrator or RK4(), dt)
    for _ in range(round(seconds / dt)):
        x = step.advance(x, u, u)
        path.append(x.numpy()[:, 0].copy())
    return np.stack(path)


@pytest.mark.parametrize("model", MODELS)
def test_derivatives(model):
    """By states and controls, from rest to speed and far beyond all limits."""
    rng, m = np.random.default_rng(1), model.state_size
    point = rng.normal(size=(m + 2, 8)) * 0.5
    point[3] = [0.0, 0.2, 0.5, 1.0, 3.0, 8.0, 15.0, -0.3]
    point[m] = 0.6 * np.linspace(-2, 2, 8)
    point[m + 1] = [-30.0, -9.0, -3.0, -0.5, 0.06, 0.5, 3.0, 9.0]

    def call(rows):
        kind = dr.llvm.ad.ArrayXf64
        u = model.saturate(kind(rows[m], rows[m + 1]))
        return model.derivative(kind(*rows[:m]), u)

    for _ in range(3):
        tangent, h = rng.normal(size=point.shape), 1e-5
        rows = [row64(value) for value in point]
        dr.enable_grad(*rows)
        result = call(rows)
        for row, direction in zip(rows, tangent, strict=True):
            dr.set_grad(row, row64(direction))
        slope = dr.forward_to(result, flags=dr.ADFlag.ClearEdges).numpy()
        high, low = (
            call([row64(value) for value in point + s * tangent]).numpy()
            for s in (h, -h)
        )
        np.testing.assert_allclose(slope, (high - low) / (2 * h), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_limits_are_smooth_and_differ_for_brakes(model):
    values = np.array([-1e3, -8.0, -4.0, 0.0, 1.5, 3.0, 1e3])
    u = controls64(np.linspace(-2, 2, 7), values)
    dr.enable_grad(u)
    limited = model.saturate(u)
    half = 2**-0.125
    expected = [-8, -8 * half, -4, 0, 1.5, 3 * half, 3]
    np.testing.assert_allclose(limited[1].numpy(), expected, rtol=1e-3)
    assert np.abs(limited[0].numpy()).max() <= 0.6
    dr.backward(dr.sum(limited[0] + limited[1]))
    assert (dr.grad(u).numpy() > 0).all()


def test_stopping_distance_and_rest():
    """`v^2 / 2b + pi^2 v0^2 / 12b` with the brake b and the stop speed v0."""
    path = drive(ROLLING, ([0.0], [-5.0]), 6.0)
    brake = -float(ROLLING.saturate(controls64([0.0], [-5.0]))[1][0])
    expected = (8.0**2 / 2 + np.pi**2 * 0.5**2 / 12) / brake
    assert path[-1, 0] == pytest.approx(expected, rel=1e-4)
    assert (path[:, 3] > 0).all() and path[-1, 3] < 1e-6
    assert (np.diff(path[:, 0]) >= 0).all()
    # coarse steps of the simplest method swing about rest and come to it
    coarse = drive(ROLLING, ([0.0], [-30.0]), 6.0, 0.1, integrator=ExplicitEuler())
    assert abs(coarse[-1, 3]) < 1e-3 and coarse[:, 3].min() > -0.4
    # and from there the car moves off
    gone = drive(ROLLING, ([0.0], [1.0]), 1.0, start=[[0.0]] * 4)
    assert gone[-1, 3] == pytest.approx(1.0, rel=1e-3)


def test_command_of_a_standing_car_has_no_kink():
    ends = [longitudinal(row64([0.0]), row64([a]), 0.5).numpy() for a in (0.0, 0.1)]
    np.testing.assert_allclose(np.ravel(ends), [0.0, 0.1], atol=1e-12)
    a = row64([0.0, 0.1])
    dr.enable_grad(a)
    dr.backward(dr.sum(longitudinal(row64([0.0, 0.0]), a, 0.5)))
    np.testing.assert_allclose(dr.grad(a).numpy(), [0.0, 1.0], atol=1e-12)


def test_without_acceleration_it_is_ackermann():
    model, twin = replace(ROLLING, speed=4.0), Ackermann(4.0, 2.5, 0.6)
    path, x = drive(model, ([0.3], [0.0]), 1.0), state64(np.zeros((3, 1)))
    for _ in range(50):
        x = RK4().step(twin, x, twin.saturate(row64([0.3])), 0.02)
    np.testing.assert_allclose(path[-1, :3], x.numpy()[:, 0], atol=1e-9)


def test_steady_circle_is_that_of_the_understeer_gradient():
    """`r = v u / (l + K v^2)`, `K = m / l (b / C_front - f / C_rear)`."""
    steer, speed = 0.01, 12.0
    path = drive(LINEAR, ([steer], [0.0]), 3.0, 0.005)
    gradient = 1400 / 2.7 * (1.5 / 8e4 - 1.2 / 9e4)
    speed = path[-1, 3]
    expected = speed * steer / (2.7 + gradient * speed**2)
    assert path[-1, 5] == pytest.approx(expected, rel=2e-3)
    # the centre of gravity slips outwards by `b / R - f m v^2 / (C_rear l R)`
    radius = speed / path[-1, 5]
    slip = 1.5 / radius - 1.2 * 1400 * speed**2 / (9e4 * 2.7 * radius)
    assert path[-1, 4] / speed == pytest.approx(slip, rel=5e-3)


def test_grip_ends_at_the_friction():
    path = drive(replace(SLIPPING, speed=20.0), ([0.5], [0.0]), 2.0, 0.005)
    sideways = path[1:, 5] * path[1:, 3] + np.diff(path[:, 4]) / 0.005
    assert np.abs(sideways).max() <= 0.9 * GRAVITY * 1.001
    rolling = drive(replace(ROLLING, speed=20.0), ([0.5], [0.0]), 2.0, 0.005)
    assert abs(path[-1, 2]) < 0.2 * abs(rolling[-1, 2])


def test_slow_tyres_roll():
    """At walking speed the path is that of the kinematic bicycle; at rest none."""
    twin = KinematicBicycle(1.0, 1.2, 1.5, 0.6)
    path = drive(replace(SLIPPING, speed=1.0), ([0.4], [0.0]), 2.0, 0.01)
    turned = float(twin.derivative(state64([[0.0]] * 3), row64([0.4]))[2][0])
    assert path[-1, 5] == pytest.approx(turned * path[-1, 3], rel=0.06)
    standing = drive(SLIPPING, ([0.4], [-8.0]), 2.0, 0.01, start=[[0.0]] * 6)
    np.testing.assert_allclose(standing, 0, atol=1e-12)


def test_steps_within_the_fastest_rate_stay_calm():
    """Emergency braking in a turn, from speed to rest."""
    for size in (1.0, 0.2):  # a car, and one that is far stiffer
        model = replace(SLIPPING, yaw_inertia=2200 * size)
        path = drive(model, ([0.4], [-8.0]), 5.0, 2.5 / model.fastest_rate)
        assert np.isfinite(path).all() and np.abs(path[-1, 3:]).max() < 1e-2


def test_speeds():
    """Along the heading, of all models, with a derivative."""
    state = np.array([[0.0, 1.0], [2.0, 3.0], [0.4, -0.3], [6.0, 7.0], [1, 2], [0, 1]])
    pairs = [
        (Dubins(5.0), [5.0, 5.0]),
        (Ackermann(4.0), [4.0, 4.0]),
        (RateLimitedAckermann(3.0), [3.0, 3.0]),
        (KinematicBicycle(2.0), [2.0, 2.0]),
        (ROLLING, [6.0, 7.0]),
        (SLIPPING, [6.0, 7.0]),
    ]
    for model, expected in pairs:
        x = state64(state[: model.state_size])
        np.testing.assert_allclose(model.speed_of(x).numpy(), expected, rtol=1e-12)

    x = state64(state[:4])
    dr.enable_grad(x)
    # of the base class, which differentiates the position, with two controls
    speed = AbstractDynamics.speed_of(ROLLING, x)
    np.testing.assert_allclose(speed.numpy(), [6, 7], rtol=1e-12)
    dr.backward(dr.sum(speed))
    np.testing.assert_allclose(dr.grad(x).numpy()[3], [1, 1], rtol=1e-12)


def test_speed_as_control():
    """Nothing reads a speed of 0 from a state that has none."""

    def kinematic(state, control):
        steering, speed = control
        _, _, theta = state
        return speed * dr.cos(theta), speed * dr.sin(theta), steering

    model = FunctionDynamics(kinematic, controls=2)
    varied = Varied(model, Variation(speed_sd=0.1, steering_lag_s_sd=0.1), 0.1)
    for vehicle in (model, varied):
        assert not vehicle.has_speed
        with pytest.raises(InputError, match=r"FunctionDynamics.*policy\.inputs"):
            vehicle.speed_of(state64(vehicle.extend(np.zeros(3)).T))
    for vehicle in (Dubins(5.0), KinematicBicycle(4.0, 1.1, 1.4, 1.2), ROLLING):
        assert vehicle.has_speed


@dataclass(frozen=True)
class Commanded(AbstractDynamics):
    """Vehicle whose author says which speed its states have."""

    def derivative(self, state, control):
        return type(state)(control * dr.cos(state[2]), control * dr.sin(state[2]), 0)

    def saturate(self, control):
        return control

    def speed_of(self, state):
        return type(state[0])(3.0)


def test_a_speed_of_its_own():
    """Counts, also for a vehicle that varies."""
    variation = Variation(speed_sd=0.2, seed=1)
    vehicle = Varied(Commanded(), variation, 0.1)
    assert vehicle.has_speed and Commanded().has_speed
    speed = vehicle.speed_of(state64(np.zeros((3, 4)))).numpy()
    np.testing.assert_allclose(speed, 3 * variation.draws(0, 4).speed)


def test_vehicles_start_at_their_speed():
    poses = np.array([[1.0, 2.0, 0.3]])
    np.testing.assert_array_equal(ROLLING.extend(poses), [[1, 2, 0.3, 8]])
    np.testing.assert_array_equal(SLIPPING.extend(poses), [[1, 2, 0.3, 12, 0, 0]])


def test_single_precision_stays_single():
    for model in MODELS:
        x = np.random.default_rng(4).normal(size=(model.state_size, 5)) * 0.4
        u = np.array([[0.1] * 5, [-1.0] * 5])
        state, control = (mi.ArrayXf(*[mi.Float(r) for r in v]) for v in (x, u))
        single = RK4().step(model, state, model.saturate(control), 0.01)
        limited = model.saturate(controls64(*u))
        double = RK4().step(model, state64(x), limited, 0.01)
        assert type(single) is mi.ArrayXf
        np.testing.assert_allclose(single.numpy(), double.numpy(), atol=1e-5)


test_refused = refusals(
    (lambda: KinematicSingleTrack(max_brake=-1.0), "max_brake"),
    (lambda: DynamicSingleTrack(mass=0.0), "mass"),
    (
        lambda: require_controls(1, ROLLING.control_names),
        "gives 1, the vehicle takes 2: steering, acceleration",
    ),
)
