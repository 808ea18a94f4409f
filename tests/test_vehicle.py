"""Vehicle models, integrators, route and expert against closed forms."""

from __future__ import annotations

import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
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
    LaneFollower,
    Route,
    smooth_absolute,
)
from mi_nerfattack.vehicle.dynamics import soft_limit
from mi_nerfattack.vehicle.integrators import state_jacobian

INTEGRATORS = [ExplicitEuler(), RK4(), ImplicitMidpoint()]
DYNAMICS = [Dubins(5.0), Ackermann(4.0, 2.5, 0.6)]
ROUTES_FILE = Path(__file__).parents[1] / "scenes" / "intersection" / "routes.json"


pytestmark = pytest.mark.usefixtures("variant")


def array64(values):
    """Upload (3, n) as a differentiable float64 state."""
    return dr.llvm.ad.Array3f64(np.asarray(values, np.float64))


def row64(values):
    return dr.llvm.ad.Float64(np.asarray(values, np.float64))


def lane(lead=15.0, radius=6.0, turn=np.pi / 2, tail=15.0, step=0.5):
    """Route of a straight, a left (turn > 0) or right arc and a straight."""
    sign, turn = np.sign(turn), abs(turn)
    length = lead + radius * turn + tail
    s = np.linspace(0, length, round(length / step) + 1)
    angle = np.clip((s - lead) / radius, 0, turn)
    after = np.maximum(s - lead - radius * turn, 0)
    x = np.minimum(s, lead) + radius * np.sin(angle) + after * np.cos(turn)
    y = radius * (1 - np.cos(angle)) + after * np.sin(turn)
    return Route("lane", 0, np.stack([x, sign * y], axis=1))


def circle_error(integrator, steps, speed=5.0, rate=0.8, duration=2.0):
    """Distance from the closed form of a circle of radius speed / rate."""
    state = array64([[0.0], [0.0], [0.3]])
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
        Dubins(5.0), array64([[1.0], [2.0], [0.4]]), row64([0.7]), 0.1
    )
    middle = 0.4 + 0.05 * 0.7
    exact = [1 + 0.5 * np.cos(middle), 2 + 0.5 * np.sin(middle), 0.47]
    np.testing.assert_allclose(state.numpy()[:, 0], exact, rtol=0, atol=1e-14)


def test_rk4_on_circle_of_radius_v_over_u():
    assert circle_error(RK4(), 20) < 1e-5


def test_ackermann_turn_radius():
    state, radius = array64([[0.0], [0.0], [0.0]]), 2.5 / np.tan(0.3)
    for _ in range(100):
        state = RK4().step(Ackermann(4.0, 2.5), state, row64([0.3]), 0.1)
        dr.eval(state)
    x, y = state.numpy()[:2, 0]
    assert np.hypot(x, y - radius) == pytest.approx(radius, rel=1e-6)


class Spring(AbstractDynamics):
    """User's own stiff nonlinear model, to which Newton must really iterate."""

    def derivative(self, state, control):
        return type(state)(
            state[1], -6 * state[0] ** 3 - state[1] + control, state[0] - 50 * state[2]
        )

    def saturate(self, control):
        return control


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("dynamics", [*DYNAMICS, Spring()])
def test_residual_of_a_step_is_zero(integrator, dynamics):
    rng = np.random.default_rng(1)
    x_prev, u = array64(rng.normal(size=(3, 7))), row64(rng.uniform(-0.5, 0.5, 7))
    x = integrator.step(dynamics, x_prev, u, 0.05)
    residual = integrator.residual(dynamics, x_prev, x, u, 0.05)
    assert np.abs(residual.numpy()).max() < 1e-13
    assert integrator.explicit != isinstance(integrator, ImplicitMidpoint)


def test_midpoint_reports_divergence():
    with pytest.raises(InputError, match=r"dt = 3.0 s.*smaller dt"):
        ImplicitMidpoint(1).step(
            Spring(), array64([[2.0], [9.0], [0.0]]), row64([0.0]), 3.0
        )
    with pytest.raises(InputError, match="iterations"):
        ImplicitMidpoint(0)


def test_state_jacobian_where_a_rate_is_itself_a_state():
    columns = state_jacobian(Spring(), array64([[0.5], [0.3], [0.2]]), row64([0.1]))
    matrix = np.stack([column.numpy()[:, 0] for column in columns], axis=1)
    np.testing.assert_allclose(matrix, [[0, 1, 0], [-4.5, -1, 0], [1, 0, -50]])


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("dynamics", [*DYNAMICS, Spring()])
@pytest.mark.parametrize("function", ["step", "residual"])
def test_derivatives(integrator, dynamics, function):
    """Forward mode equals central differences; reverse mode is its transpose."""
    rng = np.random.default_rng(2)
    point = rng.normal(size=(7, 4)) * 0.5
    tangent, cotangent = rng.normal(size=(7, 4)), rng.normal(size=(3, 4))

    def split(values):
        return [row64(v) for v in values]

    def pack(rows):
        state = dr.llvm.ad.Array3f64
        return [state(*rows[:3]), state(*rows[3:6]), rows[6]]

    def call(rows):
        x_prev, x, u = pack(rows)
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
    dr.backward(dr.sum(dr.dot(call(rows), array64(cotangent))))
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
@settings(max_examples=50, deadline=None)
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
    ],
)
def test_dynamics_reject_parameters(make):
    with pytest.raises(InputError):
        make()


def test_float32_state_and_batch_of_the_active_variant():
    state = mi.Vector3f(np.zeros((3, 5)))
    u = mi.Float(np.linspace(-1, 1, 5))
    for integrator in INTEGRATORS:
        assert integrator.step(Dubins(5.0), state, u, 0.1).numpy().shape == (3, 5)


def track(route, states):
    """Evaluate the Dr.Jit cross-track error of states (n, 3) and its gradient."""
    state = array64(np.atleast_2d(states).T)
    dr.enable_grad(state)
    error = route.cross_track(state)
    dr.backward(dr.sum(error))
    return error.numpy(), dr.grad(state).numpy().T


STRAIGHT = Route("straight", 0, [[0, 0], [3, 0], [10, 0]])


@pytest.mark.parametrize(
    ("state", "error"),
    [
        ([5, 1.5, 0], 1.5),
        ([5, -1.5, 0], -1.5),
        ([3, 0, 0], 0.0),
        ([-4, 0.5, 0], 0.5),
        ([25, -0.25, 0], -0.25),
    ],
)
def test_cross_track_of_straight(state, error):
    value, gradient = track(STRAIGHT, state)
    assert value[0] == pytest.approx(error, abs=1e-15)
    np.testing.assert_allclose(gradient[0], [0, 1, 0], atol=1e-15)
    assert STRAIGHT.cross_track_numpy(state)[0] == pytest.approx(error, abs=1e-15)


def test_cross_track_of_arc():
    route = lane(lead=1.0, radius=6.0, step=0.005)
    angle, offset = np.meshgrid(np.linspace(0.1, 1.4, 9), [-1.0, -0.2, 0.3, 2.0])
    radius = 6 - offset.ravel()
    angle = angle.ravel()
    states = np.stack(
        [1 + radius * np.sin(angle), 6 - radius * np.cos(angle), angle], axis=1
    )
    value, gradient = track(route, states)
    np.testing.assert_allclose(value, offset.ravel(), atol=1e-6)
    inward = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    np.testing.assert_allclose(gradient, inward, atol=1e-3)
    np.testing.assert_allclose(route.heading_error_numpy(states), 0, atol=1e-3)
    heading = route.heading_error(array64(states.T)).numpy()
    np.testing.assert_allclose(heading, 0, atol=1e-3)


def test_cross_track_at_sharp_bend():
    """Distance to the vertex outside the bend, also beyond a right angle."""
    right = Route("bend", 0, [[0, 0], [10, 0], [10, -10]])
    value, gradient = track(right, [[13, 4, 0], [9, -0.5, 0], [10, 0, 0]])
    np.testing.assert_allclose(value, [5, -0.5, 0], atol=1e-15)
    np.testing.assert_allclose(gradient[0], [0.6, 0.8, 0], atol=1e-15)
    hairpin = Route("hairpin", 0, [[0, 0], [10, 0], [0, 1]])
    value, _ = track(hairpin, [[10, -2, 0], [10.5, 2, 0], [13, -1, 0], [9, 0.01, 0]])
    # The bend is to the left: its outside is on the right, so errors are negative.
    assert (value[:3] < 0).all() and value[3] > 0
    np.testing.assert_allclose(value[2], -np.hypot(3, 1), atol=1e-12)


def test_prolongation_does_not_reach_other_segments():
    loop = Route("loop", 0, [[0, 0], [10, 0], [10, 10], [5, 10], [5, 5]])
    # On the prolongation of the last segment, but beside the first one.
    np.testing.assert_allclose(track(loop, [5, 1, 0])[0], [1.0])


@given(st.lists(st.tuples(*[st.floats(-40, 40)] * 2), min_size=1, max_size=20))
@settings(max_examples=30, deadline=None)
def test_numpy_equals_drjit(positions):
    route = Route("z", 0, [[0, 0], [10, 0], [12, 5], [8, 9], [20, 20], [20, 0]])
    states = np.array([[x, y, 0.1] for x, y in positions])
    numpy_error = route.cross_track_numpy(states)
    drjit_error, gradient = track(route, states)
    np.testing.assert_allclose(np.abs(drjit_error), np.abs(numpy_error), atol=1e-6)
    np.testing.assert_allclose(np.hypot(*gradient.T[:2]), 1, atol=1e-9)


def test_cross_track_gradient_by_central_differences():
    rng = np.random.default_rng(3)
    route = lane()
    states = route.pose_at(rng.uniform(1, 35, 30), rng.normal(size=30), 0.2)
    step = 1e-6 * rng.normal(size=(30, 3))
    _, gradient = track(route, states)
    up, down = track(route, states + step)[0], track(route, states - step)[0]
    np.testing.assert_allclose((up - down) / 2, (gradient * step).sum(1), atol=1e-11)


def test_pose_at_inverts_projection():
    route = lane(turn=-np.pi / 2)
    s = np.array([-3.0, 0.0, 7.3, 60.0])
    states = route.pose_at(s, [0.4, -0.3, 1.0, -1.0], 0.2)
    arc, error, heading = route.project_numpy(states)
    np.testing.assert_allclose(arc, s, atol=1e-12)
    np.testing.assert_allclose(error, [0.4, -0.3, 1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(heading, 0.2, atol=1e-12)
    assert route.pose_at(2.0).shape == (3,)
    assert route.length == pytest.approx(30 + 3 * np.pi, rel=1e-3)


def test_one_kernel_for_every_route_and_state():
    def launches():
        history = dr.kernel_history([dr.KernelType.JIT])
        return [(entry["hash"], entry["cache_hit"]) for entry in history]

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for route, x in [(STRAIGHT, 1.0), (lane(), 7.0), (lane(turn=-1.0), 3.0)]:
            state = dr.llvm.ad.Array3f(x, 0.5, 0.1)
            dr.make_opaque(state)
            dr.eval(route.cross_track(state))
        hashes = {entry[0] for entry in launches()}
    assert len(hashes) == 1


def test_smooth_absolute():
    error = row64([0.0, 0.3, -40.0])
    dr.enable_grad(error)
    value = smooth_absolute(error, 0.4)
    dr.backward(dr.sum(value))
    np.testing.assert_allclose(value.numpy(), [0, 0.1, 1600.16**0.5 - 0.4])
    np.testing.assert_allclose(dr.grad(error).numpy()[:2], [0, 0.6])


def write_routes(folder, **changes):
    entry = {"goal": 1, "lane_width_m": 3.5, "speed_ms": 5.0}
    entry |= {"points_m": [[0, 0], [1, 0]]} | changes
    path = folder / "routes.json"
    path.write_text(json.dumps({"right": entry}))
    return path


def test_route_file(tmp_path):
    route = Route.from_file(write_routes(tmp_path), "right")
    assert (route.goal, route.lane_width_m, route.length) == (1, 3.5, 1.0)
    with pytest.raises(InputError, match="no route 'left'; it has 'right'"):
        Route.from_file(tmp_path / "routes.json", "left")
    with pytest.raises(InputError, match="absent"):
        Route.from_file(tmp_path / "absent.json", "left")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points_m": [[0, 0]]}, "at least two"),
        ({"points_m": [[0, 0], [1]]}, "pairs"),
        ({"points_m": [[0, 0], [1, 1], [1, 1]]}, "points 1 and 2"),
        ({"points_m": [[0, 0], [1, None]]}, "finite"),
        ({"lane_width_m": -1}, "lane_width_m -1"),
        ({"speed_ms": "5"}, "speed_ms"),
        ({"goal": 1.5}, "goal"),
        ({"goal": -1}, "goal"),
    ],
)
def test_route_file_errors(tmp_path, changes, message):
    path = write_routes(tmp_path, **changes)
    with pytest.raises(InputError, match=message) as error:
        Route.from_file(path, "right")
    assert "routes.json" in str(error.value)


def drive(route, integrator, start, steps):
    """Follow the route at 5 m/s with 0.1 s steps; return errors (steps, n)."""
    euler = isinstance(integrator, ExplicitEuler)
    expert = LaneFollower(route, 5.0, heading_preview_m=0.25 if euler else 0.0)
    states, errors = np.atleast_2d(start), []
    for _ in range(steps):
        control = row64(expert.control(states))
        assert np.abs(control.numpy()).max() <= 1.5
        state = integrator.step(Dubins(5.0), array64(states.T), control, 0.1)
        states = state.numpy().T
        errors.append(route.cross_track_numpy(states))
    return np.abs(errors)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("turn", [np.pi / 2, -np.pi / 2, 1e-9])
def test_expert_follows_and_recovers(integrator, turn):
    route = lane(turn=turn)
    assert drive(route, integrator, route.pose_at(0.0), 70).mean() < 0.03
    lateral, heading = np.meshgrid([-1.5, -0.5, 1.5], [-0.4, 0.0, 0.4])
    start = route.pose_at(0.0, lateral.ravel(), heading.ravel())
    errors = drive(route, integrator, start, 70)
    assert errors[28:].max() < 0.1
    assert errors[-5:].max() < 0.05


@pytest.mark.skipif(not ROUTES_FILE.exists(), reason="scene not built")
@pytest.mark.parametrize("name", ["straight", "right", "left"])
def test_expert_on_bundled_routes(name):
    route = Route.from_file(ROUTES_FILE, name)
    steps = int(route.length / 0.5)
    assert drive(route, RK4(), route.pose_at(0.0), steps).mean() < 0.03
