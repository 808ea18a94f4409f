"""Vehicles with slip and with a steering lag, and the linear systems of their steps."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.states import row64, state64
from scipy.integrate import solve_ivp

from mi_nerfattack.vehicle import (
    RK4,
    Ackermann,
    Dubins,
    ExplicitEuler,
    ImplicitMidpoint,
    KinematicBicycle,
    RateLimitedAckermann,
)
from mi_nerfattack.vehicle.linear import solve_columns

pytestmark = pytest.mark.usefixtures("variant")

MODELS = [
    Dubins(5.0, 1.5),
    Ackermann(4.0, 2.5, 0.6),
    KinematicBicycle(4.0, 1.1, 1.4, 0.6),
    RateLimitedAckermann(4.0, 2.5, 0.6, 0.7, 0.1),
]
LIMITS = [1.5, 0.6, 0.6, 0.6]
LAG = MODELS[3]


def drive(dynamics, start, controls, dt, integrator=None):
    """Return the states (m, steps + 1) of one vehicle; controls are not limited."""
    x, path = state64(np.reshape(start, (-1, 1))), [np.array(start, float)]
    for control in controls:
        x = (integrator or RK4()).step(dynamics, x, row64([control]), dt)
        dr.eval(x)
        path.append(x.numpy()[:, 0].copy())
    return np.stack(path, axis=1)


def saturated_derivative(dynamics, x, u):
    return dynamics.derivative(x, dynamics.saturate(u))


def difference(f, h):
    """Differentiate at 0 with an error of sixth order."""
    return (
        45 * (f(h) - f(-h)) - 9 * (f(2 * h) - f(-2 * h)) + (f(3 * h) - f(-3 * h))
    ) / (60 * h)


@pytest.mark.parametrize(("dynamics", "limit"), list(zip(MODELS, LIMITS, strict=True)))
def test_jacobians(dynamics, limit):
    """Forward mode is central differences to 1e-8; reverse mode its transpose."""
    rng, m = np.random.default_rng(1), dynamics.state_size
    # Controls from zero to far beyond their limit.
    point = np.vstack([rng.normal(size=(m, 6)) * 0.4, limit * np.linspace(0, 2.5, 6)])
    cotangent = rng.normal(size=(m, 6))
    scale = np.array([1.0] * m + [limit])[:, None]
    for _ in range(3):
        tangent = rng.normal(size=point.shape) * scale

        def call(values):
            return saturated_derivative(dynamics, state64(values[:m]), row64(values[m]))

        def shifted(h, tangent=tangent):
            return call(point + h * tangent).numpy()

        numeric = difference(shifted, 3e-4)
        x, u = state64(point[:m]), row64(point[m])
        dr.enable_grad(x, u)
        dr.set_grad(x, state64(tangent[:m]))
        dr.set_grad(u, row64(tangent[m]))
        forward = dr.forward_to(saturated_derivative(dynamics, x, u)).numpy()
        np.testing.assert_allclose(
            forward, numeric, rtol=1e-8, atol=1e-8 * np.abs(numeric).max()
        )
        x, u = state64(point[:m]), row64(point[m])
        dr.enable_grad(x, u)
        result = saturated_derivative(dynamics, x, u)
        dr.backward(dr.sum(dr.sum(result * state64(cotangent), axis=0)))
        reverse = np.vstack([dr.grad(x).numpy(), dr.grad(u).numpy()[None]])
        left, right = (reverse * tangent).sum(), (forward * cotangent).sum()
        assert left == pytest.approx(right, rel=1e-12)


def test_bicycle_is_ackermann_seen_from_the_middle():
    """Its rear axle follows Ackermann's path at the speed v cos(beta)."""
    steer = 0.4 * np.sin(np.arange(80) / 9)
    path = drive(MODELS[2], [1.4, 0.0, 0.0], steer, 0.05)
    x = y = heading = 0.0
    for angle in steer:  # an arc of the rear axle a step
        slip = np.arctan(1.4 / 2.5 * np.tan(angle))
        length, turn = 4.0 * np.cos(slip) * 0.05, np.tan(angle) / 2.5
        chord = length * np.sinc(length * turn / 2 / np.pi)
        x += chord * np.cos(heading + length * turn / 2)
        y += chord * np.sin(heading + length * turn / 2)
        heading += length * turn
    end = path[:, -1]
    rear = end[0] - 1.4 * np.cos(end[2]), end[1] - 1.4 * np.sin(end[2])
    np.testing.assert_allclose([*rear, end[2]], [x, y, heading], atol=1e-6)


@pytest.mark.parametrize("integrator", [ExplicitEuler(), RK4(), ImplicitMidpoint()])
def test_steering_keeps_its_rate_and_angle(integrator):
    commands = LAG.saturate(row64([9.0] * 25 + [-9.0] * 60)).numpy()
    delta = drive(LAG, [0.0, 0.0, 0.0, 0.0], commands, 0.05, integrator)[3]
    assert np.abs(np.diff(delta)).max() <= 0.7 * 0.05 * (1 + 1e-12)
    assert np.abs(delta).max() <= 0.6 * (1 + 1e-12)
    # Far from its command it turns at the full rate: the limit is not a slow one.
    assert delta[10] == pytest.approx(0.7 * 0.5, rel=1e-3)
    np.testing.assert_allclose(delta[[25, 85]], [0.6, -0.6], rtol=2e-3)


def test_saturated_steering_can_still_be_moved():
    """Beyond both limits a derivative remains, in every step of a long turn."""
    u = row64([0.65, 1.2, -1.2])
    dr.enable_grad(u)
    x = state64(np.zeros((4, 3)))
    for _ in range(8):
        x = RK4().step(LAG, x, LAG.saturate(u), 0.05)
    dr.backward(dr.sum(x[2]))
    slope = dr.grad(u).numpy()
    assert (slope > 1e-12).all()
    assert slope[0] > slope[1]
    assert slope[1] == pytest.approx(slope[2], rel=1e-12)


@pytest.mark.parametrize(("integrator", "order"), [(RK4(), 4), (ImplicitMidpoint(), 2)])
def test_orders_with_four_rows(integrator, order):
    def slope(_, x):
        raw = (0.25 - x[3]) / 0.1
        rate = raw / (1 + (raw / 0.7) ** 8) ** 0.125
        return [4 * np.cos(x[2]), 4 * np.sin(x[2]), 4 / 2.5 * np.tan(x[3]), rate]

    start = [0.0, 0.0, 0.4, 0.2]
    exact = solve_ivp(slope, (0, 0.6), start, rtol=1e-12, atol=1e-13).y[:, -1]
    command = 0.25
    errors = [
        np.abs(steps_to(integrator, start, command, n) - exact).max() for n in (20, 40)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


def steps_to(integrator, start, command, count):
    """Drive 0.6 s in `count` steps with an unsaturated command."""
    x = state64(np.reshape(start, (4, 1)))
    for _ in range(count):
        x = integrator.step(LAG, x, row64([command]), 0.6 / count)
        dr.eval(x)
    return x.numpy()[:, 0]


def test_states_start_at_rest():
    poses = np.array([[1.0, 2.0, 0.3], [4.0, 5.0, 0.6]])
    np.testing.assert_array_equal(MODELS[0].extend(poses), poses)
    np.testing.assert_array_equal(LAG.extend(poses), np.c_[poses, [0.0, 0.0]])
    np.testing.assert_array_equal(LAG.extend(poses[0]), [[1.0, 2.0, 0.3, 0.0]])
    assert [model.state_size for model in MODELS] == [3, 3, 3, 4]


@pytest.mark.parametrize("integrator", [RK4(), ImplicitMidpoint()])
@pytest.mark.parametrize("dynamics", MODELS[2:])
def test_steps_and_their_derivatives_can_be_recorded(integrator, dynamics):
    """One recording serves other values; nothing is compiled for them."""
    assert dynamics.recordable

    def step(x, u):
        return integrator.step(dynamics, x, dynamics.saturate(u), 0.1)

    def product(x, u, weight):
        x, u = type(x)(x), type(u)(u)
        dr.enable_grad(x, u)
        dr.backward_from(dr.sum(step(x, u) * weight, axis=0))
        return dr.grad(x), dr.grad(u)

    frozen = dr.freeze(lambda x, u, weight: (step(x, u), product(x, u, weight)))
    rng, m = np.random.default_rng(3), dynamics.state_size
    for _ in range(3):
        arrays = rng.normal(size=(2 * m + 1, 4)) * 0.4
        # lists: the alignment of NumPy's memory is part of a recording
        rows = [dr.llvm.ad.Float64(item) for item in arrays.tolist()]
        kind = type(state64(arrays[:m]))
        arguments = kind(*rows[:m]), rows[m], kind(*rows[m + 1 :])
        found, gradients = frozen(*arguments)
        expected = step(*arguments[:2])
        np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=1e-13)
        for one, other in zip(gradients, product(*arguments), strict=True):
            np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-13)
    assert frozen.n_recordings == 1


def matrices(size):
    """Return well-conditioned systems that need a pivot in every column, (k, m, m)."""
    rng = np.random.default_rng(size)
    shuffled = [np.eye(size)[rng.permutation(size)] for _ in range(6)]
    return np.array(shuffled) * 2 + rng.uniform(-0.2, 0.2, (6, size, size))


def solve(systems, right):
    columns = [state_of(systems[:, :, j].T) for j in range(systems.shape[1])]
    return solve_columns(columns, state_of(right.T))


def state_of(values):
    """Upload (m, n) for any m."""
    return dr.llvm.ad.ArrayXf64(*[row64(item) for item in values])


@pytest.mark.parametrize("size", [1, 2, 3, 4, 6])
def test_solve_columns(size):
    systems = matrices(size)
    systems[0] = np.eye(size)[::-1] * 3  # zeros on the diagonal
    right = np.random.default_rng(9).normal(size=(6, size))
    expected = np.linalg.solve(systems, right[:, :, None])[:, :, 0]
    np.testing.assert_allclose(solve(systems, right).numpy().T, expected, rtol=1e-12)


def test_solve_columns_derivative():
    """`dx = A^-1 (db - dA x)`, in both modes."""
    systems, rng = matrices(4), np.random.default_rng(2)
    right, d_right = rng.normal(size=(2, 6, 4))
    d_systems, weight = rng.normal(size=systems.shape), rng.normal(size=(6, 4))
    x = np.linalg.solve(systems, right[:, :, None])
    expected = np.linalg.solve(systems, d_right[:, :, None] - d_systems @ x)[:, :, 0]
    leaves = [state_of(systems[:, :, j].T) for j in range(4)] + [state_of(right.T)]
    tangents = [state_of(d_systems[:, :, j].T) for j in range(4)]
    tangents.append(state_of(d_right.T))
    dr.enable_grad(*leaves)
    for leaf, tangent in zip(leaves, tangents, strict=True):
        dr.set_grad(leaf, tangent)
    # The last unknown is an input of the others, whose gradient must be kept.
    result = solve_columns(leaves[:4], leaves[4])
    forward = dr.forward_to(result, flags=dr.ADFlag.ClearEdges).numpy().T
    np.testing.assert_allclose(forward, expected, rtol=1e-11)
    leaves = [type(leaf)(dr.detach(leaf)) for leaf in leaves]
    dr.enable_grad(*leaves)
    result = solve_columns(leaves[:4], leaves[4])
    dr.backward(dr.sum(dr.sum(result * state_of(weight.T), axis=0)))
    left = sum(
        (dr.grad(leaf).numpy() * tangent.numpy()).sum()
        for leaf, tangent in zip(leaves, tangents, strict=True)
    )
    assert left == pytest.approx((forward * weight).sum(), rel=1e-11)


def test_solve_columns_in_single_precision():
    systems = matrices(4)
    columns = [
        mi.ArrayXf(*[mi.Float(item) for item in systems[:, :, j].T]) for j in range(4)
    ]
    found = solve_columns(columns, mi.ArrayXf(1, 2, 3, 4))
    expected = np.linalg.solve(systems, np.array([1.0, 2, 3, 4])[None, :, None])
    np.testing.assert_allclose(found.numpy().T, expected[:, :, 0], rtol=1e-5)
