"""Vehicle models and time steps against closed forms, scipy and differences."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.faults.refusals import refusals
from support.reference.derivatives import row64, state64

from mi_nerfattack.vehicle import (
    RK4,
    AbstractDynamics,
    Ackermann,
    Dubins,
    ExplicitEuler,
    ImplicitMidpoint,
    KinematicBicycle,
    RateLimitedAckermann,
)
from mi_nerfattack.vehicle.integrators import solve_columns
from mi_nerfattack.vehicle.steering import heading_rate, steering_angle

pytestmark = pytest.mark.usefixtures("variant")

INTEGRATORS = [ExplicitEuler(), RK4(), ImplicitMidpoint()]
ORDERS = list(zip(INTEGRATORS, (1, 4, 2), strict=True))
LAG = RateLimitedAckermann(4.0, 2.5, 0.6, 0.7, 0.1)
ACKERMANN, BICYCLE = Ackermann(4.0, 2.5, 0.6), KinematicBicycle(4.0, 1.1, 1.4, 0.6)
#: Models with their limits of the control.
MODELS = [(Dubins(5.0, 1.5), 1.5), (ACKERMANN, 0.6), (BICYCLE, 0.6), (LAG, 0.6)]


class Spring(AbstractDynamics):
    """User's own stiff nonlinear model, to which Newton must really iterate."""

    def derivative(self, state, control):
        return type(state)(
            state[1], -6 * state[0] ** 3 - state[1] + control, state[0] - 50 * state[2]
        )

    def saturate(self, control):
        return control


def drive(dynamics, start, controls, dt, integrator=INTEGRATORS[1]):
    """Return the states (m, steps + 1) of one vehicle; controls are not limited."""
    x, path = state64(np.reshape(start, (-1, 1))), [np.array(start, float)]
    for control in controls:
        x = integrator.step(dynamics, x, row64([control]), dt)
        dr.eval(x)
        path.append(x.numpy()[:, 0].copy())
    return np.stack(path, axis=1)


def forward_mode(call, point, tangent, cotangent):
    """Differentiate a function of rows; reverse mode must be the transpose."""
    rows = [row64(value) for value in point]
    dr.enable_grad(*rows)
    result = call(rows)
    for row, direction in zip(rows, tangent, strict=True):
        dr.set_grad(row, row64(direction))
    # an entry may be an input of the others, whose gradient must be kept
    forward = dr.forward_to(result, flags=dr.ADFlag.ClearEdges).numpy()
    rows = [row64(value) for value in point]
    dr.enable_grad(*rows)
    weights = [row64(value) for value in cotangent]
    result = call(rows)
    dr.backward(sum(dr.sum(a * b) for a, b in zip(result, weights, strict=True)))
    reverse = np.stack([dr.grad(row).numpy() for row in rows])
    left, right = (reverse * tangent).sum(), (forward * cotangent).sum()
    assert left == pytest.approx(right, rel=1e-11)
    return forward


def difference(call, point, tangent, h):
    def f(s):
        return call([row64(value) for value in point + s * h * tangent]).numpy()

    return (45 * (f(1) - f(-1)) - 9 * (f(2) - f(-2)) + f(3) - f(-3)) / (60 * h)


def rows_of(values):
    return (dr.llvm.ad.Array3f64 if len(values) == 3 else dr.llvm.ad.ArrayXf64)(*values)


@pytest.mark.parametrize(("dynamics", "limit"), MODELS)
def test_jacobians(dynamics, limit):
    """With controls from zero to far beyond their limit."""
    rng, m = np.random.default_rng(1), dynamics.state_size
    point = np.vstack([rng.normal(size=(m, 6)) * 0.4, limit * np.linspace(0, 2.5, 6)])
    cotangent = rng.normal(size=(m, 6))

    def call(rows):
        return dynamics.derivative(rows_of(rows[:m]), dynamics.saturate(rows[m]))

    for _ in range(3):
        tangent = rng.normal(size=point.shape)
        tangent[m] *= limit
        expected = difference(call, point, tangent, 3e-4)
        actual = forward_mode(call, point, tangent, cotangent)
        atol = 1e-8 * np.abs(expected).max()
        np.testing.assert_allclose(actual, expected, rtol=1e-8, atol=atol)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("dynamics", [LAG, Spring()])
@pytest.mark.parametrize("function", ["step", "residual"])
def test_derivatives_of_a_step(integrator, dynamics, function):
    rng, m = np.random.default_rng(2), dynamics.state_size
    point = rng.normal(size=(2 * m + 1, 4)) * 0.4
    tangent, cotangent = rng.normal(size=(2 * m + 1, 4)), rng.normal(size=(m, 4))

    def call(rows):
        x_prev, x, u = rows_of(rows[:m]), rows_of(rows[m : 2 * m]), rows[-1]
        if function == "step":
            return integrator.step(dynamics, x_prev, u, 0.1)
        return integrator.residual(dynamics, x_prev, x, u, 0.1)

    actual = forward_mode(call, point, tangent, cotangent)
    expected = difference(call, point, tangent, 1e-3)
    np.testing.assert_allclose(actual, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("dynamics", [LAG, Spring()])
def test_residual_of_a_step_is_zero(integrator, dynamics):
    rng = np.random.default_rng(1)
    x_prev = state64(0.5 * rng.normal(size=(dynamics.state_size, 7)))
    u = row64(rng.uniform(-0.5, 0.5, 7))
    x = integrator.step(dynamics, x_prev, u, 0.05)
    residual = integrator.residual(dynamics, x_prev, x, u, 0.05)
    assert np.abs(residual.numpy()).max() < 1e-13
    integrator.check(dynamics, x_prev, x, u, 0.05)


def diverged():
    start, u = state64([[2.0], [9.0], [0.0]]), row64([0.0])
    end = ImplicitMidpoint(1).step(Spring(), start, u, 3.0)
    ImplicitMidpoint(1).check(Spring(), start, end, u, 3.0)


test_refused = refusals(
    (diverged, "dt = 3.0 s"),
    (lambda: ImplicitMidpoint(0), "iterations"),
    (lambda: Dubins(5.0, float("nan")), "max_heading_rate"),
    (lambda: Ackermann(5.0, -1.0), "wheelbase"),
    (lambda: KinematicBicycle(5.0, 0.0), "front_m"),
    (lambda: RateLimitedAckermann(max_steer_rate=-1.0), "max_steer_rate"),
)


@pytest.mark.parametrize(("integrator", "order"), ORDERS)
def test_steps_converge_to_scipys_solution(integrator, order):
    def slope(_, x):
        raw = (0.25 - x[3]) / 0.1
        rate = raw / (1 + (raw / 0.7) ** 8) ** 0.125
        return [4 * np.cos(x[2]), 4 * np.sin(x[2]), 4 / 2.5 * np.tan(x[3]), rate]

    start = [0.0, 0.0, 0.4, 0.2]
    exact = solve_ivp(slope, (0, 0.6), start, rtol=1e-12, atol=1e-13).y[:, -1]
    ends = [drive(LAG, start, [0.25] * n, 0.6 / n, integrator)[:, -1] for n in (20, 40)]
    errors = np.abs(np.array(ends) - exact).max(1)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


def test_midpoint_is_its_closed_form():
    # Dubins' heading is linear in time, so the implicit step has a closed form.
    state = drive(Dubins(5.0), [1.0, 2.0, 0.4], [0.7], 0.1, ImplicitMidpoint())[:, 1]
    middle = 0.4 + 0.05 * 0.7
    exact = [1 + 0.5 * np.cos(middle), 2 + 0.5 * np.sin(middle), 0.47]
    np.testing.assert_allclose(state, exact, rtol=0, atol=1e-14)


def test_vehicles_start_at_rest():
    poses = np.array([[1.0, 2.0, 0.3], [4.0, 5.0, 0.6]])
    np.testing.assert_array_equal(MODELS[0][0].extend(poses), poses)
    np.testing.assert_array_equal(LAG.extend(poses), np.c_[poses, [0.0, 0.0]])
    np.testing.assert_array_equal(LAG.extend(poses[0]), [[1.0, 2.0, 0.3, 0.0]])


def test_steering_in_numpy_is_the_models_own():
    angles = np.array([-0.5, -0.1, 0.0, 0.3])
    rates = heading_rate(angles, 4.0, 2.5)
    turned = ACKERMANN.derivative(state64(np.zeros((3, 4))), row64(angles))[2]
    np.testing.assert_allclose(rates, turned.numpy(), rtol=1e-12)
    np.testing.assert_allclose(steering_angle(rates, 4.0, 2.5), angles, atol=1e-12)


def test_bicycle_is_ackermann_seen_from_the_middle():
    """Its rear axle follows Ackermann's path at the speed v cos(beta)."""
    steer = 0.4 * np.sin(np.arange(80) / 9)
    path = drive(BICYCLE, [1.4, 0.0, 0.0], steer, 0.05)
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


@pytest.mark.parametrize(("dynamics", "limit"), MODELS)
def test_saturation(dynamics, limit):
    u = row64(limit * np.array([-1e30, -1, -0.5, 0, 0.5, 1, 3, 1e30]))
    dr.enable_grad(u)
    y = dynamics.saturate(u)
    dr.backward(dr.sum(y))
    expected = [-1, -(2**-0.125), -0.5, 0, 0.5, 2**-0.125, 1, 1]
    np.testing.assert_allclose(y.numpy() / limit, expected, atol=3e-4)
    slope = dr.grad(u).numpy()
    assert slope[3] == 1
    np.testing.assert_allclose(slope[[1, 5]], 2**-1.125, rtol=1e-12)
    assert slope[6] == pytest.approx((1 + 3.0**8) ** (-9 / 8), rel=1e-10)
    assert np.isfinite(slope).all() and (slope >= 0).all()


@pytest.mark.parametrize("integrator", INTEGRATORS)
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
    assert (slope > 1e-12).all() and slope[0] > slope[1]
    assert slope[1] == pytest.approx(slope[2], rel=1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS[1:])
@pytest.mark.parametrize("dynamics", [BICYCLE, LAG])
def test_steps_and_their_derivatives_can_be_recorded(integrator, dynamics):
    """One recording serves other values; nothing is compiled for them."""

    def both(x, u, weight):
        end = integrator.step(dynamics, x, dynamics.saturate(u), 0.1)
        x, u = type(x)(x), type(u)(u)
        dr.enable_grad(x, u)
        again = integrator.step(dynamics, x, dynamics.saturate(u), 0.1)
        dr.backward_from(dr.sum(again * weight, axis=0))
        return end, dr.grad(x), dr.grad(u)

    assert dynamics.recordable
    frozen, rng, m = dr.freeze(both), np.random.default_rng(3), dynamics.state_size
    for _ in range(3):
        rows = [row64(item) for item in rng.normal(size=(2 * m + 1, 4)) * 0.4]
        arguments = rows_of(rows[:m]), rows[m], rows_of(rows[m + 1 :])
        for one, other in zip(frozen(*arguments), both(*arguments), strict=True):
            np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-13)
    assert frozen.n_recordings == 1


def test_float32_state_and_batch_of_the_active_variant():
    """Single precision agrees with double, and stays single."""
    rng = np.random.default_rng(4)
    u = rng.uniform(-0.5, 0.5, 5)
    for dynamics, _ in MODELS:
        m = dynamics.state_size
        x = rng.normal(size=(m, 5)) * 0.4
        kind = mi.Vector3f if m == 3 else mi.ArrayXf
        state = kind(*[mi.Float(row) for row in x])
        for integrator in INTEGRATORS:
            after = integrator.step(dynamics, state, mi.Float(u), 0.1)
            integrator.check(dynamics, state, after, mi.Float(u), 0.1)
            expected = integrator.step(dynamics, state64(x), row64(u), 0.1)
            assert type(after) is kind
            np.testing.assert_allclose(after.numpy(), expected.numpy(), atol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_solve_columns(size):
    """Systems that need a pivot in every column, and `dx = A^-1 (db - dA x)`."""
    rng = np.random.default_rng(size)
    shuffled = [np.eye(size)[rng.permutation(size)] for _ in range(6)]
    systems = np.array(shuffled) * 2 + rng.uniform(-0.2, 0.2, (6, size, size))
    systems[0] = np.eye(size)[::-1] * 3  # zeros on the diagonal
    right, d_right, weight = rng.normal(size=(3, 6, size, 1))
    d_systems = rng.normal(size=systems.shape)
    x = np.linalg.solve(systems, right)

    def rows(matrices, vectors):
        """Flatten to rows (m (m + 1), n), column by column."""
        augmented = np.concatenate([matrices, vectors], 2)
        return augmented.transpose(2, 1, 0).reshape(-1, 6)

    def call(values):
        columns = [values[i * size : (i + 1) * size] for i in range(size + 1)]
        *columns, last = (dr.llvm.ad.ArrayXf64(*column) for column in columns)
        return solve_columns(columns, last)

    point, tangent = rows(systems, right), rows(d_systems, d_right)
    solution = call([row64(value) for value in point]).numpy().T
    np.testing.assert_allclose(solution, x[..., 0], rtol=1e-12)
    derivative = forward_mode(call, point, tangent, weight[..., 0].T).T
    expected = np.linalg.solve(systems, d_right - d_systems @ x)[..., 0]
    np.testing.assert_allclose(derivative, expected, rtol=1e-11)
