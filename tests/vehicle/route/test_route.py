"""Route and expert against closed forms."""

from __future__ import annotations

import json
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle import (
    RK4,
    Dubins,
    ExplicitEuler,
    ImplicitMidpoint,
    Route,
    smooth_absolute,
)
from mi_nerfattack.vehicle.expert import LaneFollower

INTEGRATORS = [ExplicitEuler(), RK4(), ImplicitMidpoint()]
ROUTES_FILE = Path(__file__).parents[3] / "scenes" / "intersection" / "routes.json"


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
@settings(max_examples=30)
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
    assert not route.closed
    loop = {"points_m": [[0, 0], [1, 0], [0, 1]], "closed": True}
    (route,) = Route.all_from_file(write_routes(tmp_path, **loop))
    assert route.closed and route.length == pytest.approx(2 + 2**0.5)
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
        ({"points_m": [[0, 0], [1, 1e10]]}, "point 1 .* at most 1e.09 m"),
        ({"lane_width_m": -1}, "lane_width_m -1"),
        ({"speed_ms": "5"}, "speed_ms"),
        ({"goal": 1.5}, "goal"),
        ({"goal": -1}, "goal"),
        ({"closed": 1}, "closed 1; true or false"),
        ({"closed": True}, "at least three"),
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


@pytest.mark.parametrize(
    ("integrator", "turn"),
    list(zip(INTEGRATORS, [np.pi / 2, -np.pi / 2, 1e-9], strict=True)),
)
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
