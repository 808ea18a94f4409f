"""Vehicle models, and integrators against closed forms."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.states import row64, state64
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerfattack.errors import InputError
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
from mi_nerfattack.vehicle.dynamics import soft_limit

INTEGRATORS = [ExplicitEuler(), RK4(), ImplicitMidpoint()]
DYNAMICS = [
    Dubins(5.0),
    Ackermann(4.0, 2.5, 0.6),
    KinematicBicycle(4.0, 1.1, 1.4, 0.6),
    RateLimitedAckermann(4.0, 2.5, 0.6, 0.7, 0.1),
]
pytestmark = pytest.mark.usefixtures("variant")


def circle_error(integrator, steps, speed=5.0, rate=0.8, duration=2.0):
    """Distance from the closed form of a circle of radius speed / rate."""
    state = state64([[0.0], [0.0], [0.3]])
    for _ in range(steps):
        state = integrator.step(Dubins(speed), state, row64([rate]), duration / steps)
        dr.eval(state)
    radius, end = speed / rate, 0.3 + rate * duration
    exact = [
        radius * (np.sin(end) - np.sin(0.3)),
        radius * (np.cos(0.3) - np.cos(end)),
        end,
    ]
    return float(np.abs(state.numpy()[:, 0] - exact).max())


@pytest.mark.parametrize(
    ("integrator", "order"), [(INTEGRATORS[0], 1), (INTEGRATORS[1], 4)]
)
def test_convergence_order_on_circle(integrator, order):
    coarse, fine = circle_error(integrator, 20), circle_error(integrator, 40)
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.1)


def test_midpoint_second_order_and_equal_to_its_closed_form():
    rates = [circle_error(ImplicitMidpoint(), steps) for steps in (20, 40)]
    assert np.log2(rates[0] / rates[1]) == pytest.approx(2, abs=0.1)
    # Dubins' heading is linear in time, so the implicit step has a closed form.
    state = ImplicitMidpoint().step(
        Dubins(5.0), state64([[1.0], [2.0], [0.4]]), row64([0.7]), 0.1
    )
    middle = 0.4 + 0.05 * 0.7
    exact = [1 + 0.5 * np.cos(middle), 2 + 0.5 * np.sin(middle), 0.47]
    np.testing.assert_allclose(state.numpy()[:, 0], exact, rtol=0, atol=1e-14)


class Spring(AbstractDynamics):
    """User's own stiff nonlinear model, to which Newton must really iterate."""

    def derivative(self, state, control):
        return type(state)(
            state[1], -6 * state[0] ** 3 - state[1] + control, state[0] - 50 * state[2]
        )

    def saturate(self, control):
        return control


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("dynamics", [DYNAMICS[-1], Spring()])
def test_residual_of_a_step_is_zero(integrator, dynamics):
    rng = np.random.default_rng(1)
    x_prev = state64(0.5 * rng.normal(size=(dynamics.state_size, 7)))
    u = row64(rng.uniform(-0.5, 0.5, 7))
    x = integrator.step(dynamics, x_prev, u, 0.05)
    residual = integrator.residual(dynamics, x_prev, x, u, 0.05)
    assert np.abs(residual.numpy()).max() < 1e-13
    integrator.check(dynamics, x_prev, x, u, 0.05)


def test_midpoint_reports_divergence():
    start, u = state64([[2.0], [9.0], [0.0]]), row64([0.0])
    with pytest.raises(InputError, match=r"dt = 3.0 s.*smaller dt"):
        end = ImplicitMidpoint(1).step(Spring(), start, u, 3.0)
        ImplicitMidpoint(1).check(Spring(), start, end, u, 3.0)
    with pytest.raises(InputError, match="iterations"):
        ImplicitMidpoint(0)


def test_jacobian_where_a_rate_is_itself_a_state():
    columns = Spring().jacobian(state64([[0.5], [0.3], [0.2]]), row64([0.1]))
    matrix = np.stack([column.numpy()[:, 0] for column in columns], axis=1)
    np.testing.assert_allclose(matrix, [[0, 1, 0], [-4.5, -1, 0], [1, 0, -50]])


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("dynamics", [DYNAMICS[-1], Spring()])
@pytest.mark.parametrize("function", ["step", "residual"])
def test_derivatives(integrator, dynamics, function):
    """Forward mode equals central differences; reverse mode is its transpose."""
    rng, m = np.random.default_rng(2), dynamics.state_size
    point = rng.normal(size=(2 * m + 1, 4)) * 0.4
    tangent, cotangent = rng.normal(size=(2 * m + 1, 4)), rng.normal(size=(m, 4))

    def split(values):
        return [row64(v) for v in values]

    def call(rows):
        kind = type(state64(point[:m]))
        x_prev, x, u = kind(*rows[:m]), kind(*rows[m : 2 * m]), rows[-1]
        if function == "step":
            return integrator.step(dynamics, x_prev, u, 0.1)
        return integrator.residual(dynamics, x_prev, x, u, 0.1)

    h = 1e-5
    numeric = (
        call(split(point + h * tangent)).numpy()
        - call(split(point - h * tangent)).numpy()
    ) / (2 * h)
    rows = split(point)
    dr.enable_grad(*rows)
    result = call(rows)
    for row, direction in zip(rows, tangent, strict=True):
        dr.set_grad(row, row64(direction))
    forward = dr.forward_to(result).numpy()
    np.testing.assert_allclose(forward, numeric, rtol=1e-7, atol=1e-8)
    rows = split(point)
    dr.enable_grad(*rows)
    dr.backward(dr.sum(dr.sum(call(rows) * state64(cotangent), axis=0)))
    reverse = np.stack([dr.grad(row).numpy() for row in rows])
    assert (reverse * tangent).sum() == pytest.approx(
        (forward * cotangent).sum(), rel=1e-11
    )


@pytest.mark.parametrize("dynamics", DYNAMICS)
def test_saturation(dynamics):
    limit = getattr(dynamics, "max_heading_rate", None) or dynamics.max_steer
    u = row64(limit * np.array([-1e30, -1, -0.5, 0, 0.5, 1, 3, 1e30]))
    dr.enable_grad(u)
    y = dynamics.saturate(u)
    dr.backward(dr.sum(y))
    ratio = y.numpy() / limit
    expected = [-1, -(2**-0.125), -0.5, 0, 0.5, 2**-0.125, 1, 1]
    np.testing.assert_allclose(ratio, expected, atol=3e-4)
    slope = dr.grad(u).numpy()
    assert slope[3] == 1
    np.testing.assert_allclose(slope[[1, 5]], 2**-1.125, rtol=1e-12)
    assert slope[6] == pytest.approx((1 + 3.0**8) ** (-9 / 8), rel=1e-10)
    assert np.isfinite(slope).all() and (slope >= 0).all()


@given(st.floats(-1e6, 1e6), st.floats(0.01, 100))
@settings(max_examples=50)
def test_soft_limit_is_bounded_and_odd(value, limit):
    up, down = soft_limit(row64([value, -value]), limit).numpy()
    assert abs(up) <= limit * (1 + 1e-15) and up == -down


@pytest.mark.parametrize(
    "make",
    [
        lambda: Dubins(0.0),
        lambda: Dubins(5.0, float("nan")),
        lambda: Ackermann(5.0, -1.0),
        lambda: Ackermann(5.0, 2.0, 1.6),
        lambda: KinematicBicycle(5.0, 0.0),
        lambda: KinematicBicycle(0.0),
        lambda: KinematicBicycle(max_steer=1.6),
        lambda: RateLimitedAckermann(0.0),
        lambda: RateLimitedAckermann(max_steer_rate=-1.0),
        lambda: RateLimitedAckermann(time_constant=0.0),
        lambda: RateLimitedAckermann(max_steer=float("inf")),
    ],
)
def test_dynamics_reject_parameters(make):
    with pytest.raises(InputError):
        make()


def test_float32_state_and_batch_of_the_active_variant():
    """Single precision agrees with double, and stays single."""
    rng = np.random.default_rng(4)
    u = rng.uniform(-0.5, 0.5, 5)
    for dynamics in DYNAMICS:
        m = dynamics.state_size
        x = rng.normal(size=(m, 5)) * 0.4
        kind = mi.Vector3f if m == 3 else mi.ArrayXf
        state = kind(*[mi.Float(row) for row in x])
        for integrator in INTEGRATORS:
            found = integrator.step(dynamics, state, mi.Float(u), 0.1)
            integrator.check(dynamics, state, found, mi.Float(u), 0.1)
            expected = integrator.step(dynamics, state64(x), row64(u), 0.1)
            assert type(found) is kind
            np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=1e-6)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_one_vehicle_is_a_column_of_many(integrator):
    rng = np.random.default_rng(5)
    for dynamics in DYNAMICS:
        x, u = rng.normal(size=(dynamics.state_size, 6)), rng.uniform(-0.5, 0.5, 6)
        many = integrator.step(dynamics, state64(x), row64(u), 0.1).numpy()
        one = integrator.step(dynamics, state64(x[:, 3:4]), row64(u[3:4]), 0.1)
        np.testing.assert_allclose(one.numpy()[:, 0], many[:, 3], rtol=1e-14)
