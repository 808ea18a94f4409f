"""Projection onto open and closed routes: NumPy, Dr.Jit and torch against a loop."""

from __future__ import annotations

import math

import drjit as dr
import numpy as np
import pytest
import torch
from helpers.states import state64
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle import Route
from mi_nerfattack.vehicle.route.torch_route import TorchRoute

pytestmark = pytest.mark.usefixtures("variant")

QUANTITIES = ("arc_length", "cross_track", "heading_error")
ZIGZAG = [[0, 0], [10, 0], [12, 5], [8, 9], [9, 1], [20, 20], [20, 0]]
SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4]]
quarters = st.integers(-60, 60).map(lambda k: k / 4)
points_lists = st.lists(st.tuples(quarters, quarters), min_size=3, max_size=8)


def reference(points, closed, x, y, theta, within=1e-6):
    """Project one vehicle by the textbook: feet on all segments, the sign of the bend.

    Returns what each nearest foot measures and how far it is from changing segments
    [(arc length, error, heading error), border], the nearest first (all `within` metres
    of it), and whether they are one place of the route; on a medial axis they are not,
    and any of them is right.
    """
    n = len(points)
    count = n if closed else n - 1
    lengths = [math.dist(points[i], points[(i + 1) % n]) for i in range(count)]
    found = []
    for i in range(count):
        (ax, ay), (bx, by) = points[i], points[(i + 1) % n]
        tx, ty = (bx - ax) / lengths[i], (by - ay) / lengths[i]
        along = (x - ax) * tx + (y - ay) * ty
        foot = min(max(along, 0.0), lengths[i])
        miss = math.hypot(x - ax - foot * tx, y - ay - foot * ty)
        found.append((miss, sum(lengths[:i]) + foot, i, along, (tx, ty)))
    found.sort(key=lambda entry: entry[0])
    least, first_arc = found[0][:2]
    found = [entry for entry in found if entry[0] < least + within]
    apart = [abs(entry[1] - first_arc) for entry in found]
    if closed:
        apart = [min(gap, sum(lengths) - gap) for gap in apart]
    measured = []
    for miss, arc, i, along, (tx, ty) in found:
        border = min(abs(along), abs(along - lengths[i]))
        ax, ay = points[i]
        direction = math.atan2(ty, tx)
        last_on = not closed and i == count - 1 and along > lengths[i]
        first_on = not closed and i == 0 and along < 0
        if 0 <= along <= lengths[i] or last_on or first_on:
            arc, error = sum(lengths[:i]) + along, tx * (y - ay) - ty * (x - ax)
        else:
            j = (i + 1 if along > 0 else i - 1) % count
            (cx, cy), (dx, dy) = points[j], points[(j + 1) % n]
            other = math.atan2(dy - cy, dx - cx)
            first, second = (direction, other) if along > 0 else (other, direction)
            bend = math.remainder(second - first, 2 * math.pi)
            error = -math.copysign(miss, bend)  # the outside of a left bend: its right
            direction = first + bend / 2
            border = min(border, math.pi - abs(bend))
        heading = math.remainder(theta - direction, 2 * math.pi)
        measured.append(((arc, error, heading), border))
    return measured, max(apart) <= 1e-9


def all_three(route, states):
    """Return the measures of each implementation, (3 implementations, 3, n)."""
    by_drjit = [item.numpy() for item in route.project(state64(np.transpose(states)))]
    by_torch = TorchRoute(route).project(torch.tensor(states, dtype=torch.float64))
    by_torch = [item.numpy() for item in by_torch]
    return np.array([list(route.project_numpy(states)), by_drjit, by_torch])


@given(
    points_lists,
    st.booleans(),
    st.lists(
        st.tuples(st.floats(-30, 30), st.floats(-30, 30), st.floats(-7, 7)),
        min_size=1,
        max_size=12,
    ),
)
@example([(0, 0), (8, 0), (12, 5), (8, 0)], False, [(5, -9, 0)])  # ends inside
@settings(max_examples=60)
def test_three_implementations_agree_with_a_loop(points, closed, places):
    after = points[1:] + points[:1] if closed else points[1:]
    assume(all(a != b for a, b in zip(points, after, strict=False)))
    route = Route("random", 0, points, closed=closed)
    # beside the drawn places: all vertices, and past both ends
    last = route.length
    beyond = route.pose_at([-3.0, -1.0, last + 1.0, last + 3.0], 0.7, 0.1).tolist()
    states = np.array([*places, *((x, y, 0.3) for x, y in points), *beyond])
    values = all_three(route, states)
    assert np.isfinite(values).all()
    for k, state in enumerate(states):
        measured, one_place = reference(points, closed, *state)
        sizes = np.array([abs(error) for (_, error, _), _ in measured])
        misses = np.abs(np.abs(values[:, 1, k, None]) - sizes)
        np.testing.assert_allclose(misses.min(-1), 0, atol=2e-3)
        if not one_place:
            continue
        expected, border = measured[0]
        turns = values[:, 0, k] - expected[0]
        if closed:
            turns -= last * np.round(turns / last)
        np.testing.assert_allclose(turns, 0, atol=1e-9)
        if border > 2e-3:
            np.testing.assert_allclose(values[:, 1, k], expected[1], atol=1e-9)
            turns = values[:, 2, k] - expected[2]
            np.testing.assert_allclose(np.sin(turns / 2), 0, atol=1e-9)


@pytest.mark.parametrize("offset", [1e-5, -1e-5, 3e-3, -3e-3])
def test_close_to_a_vertex(offset):
    """The sign is right, and the error within a millimetre, at any distance."""
    route = Route("bend", 0, [[0, 0], [10, 0], [10, 10]])
    x, y = 10 + offset, -offset
    _, errors, _ = all_three(route, [[x, y, 0.0]]).T[0]
    distance = math.hypot(x - 10, y) if offset > 0 else abs(offset)
    expected = -math.copysign(distance, offset)
    np.testing.assert_allclose(errors, expected, atol=1e-3)
    assert (np.sign(errors) == np.sign(expected)).all()


def test_complete_reversal():
    """There and back again: beyond the end is right of a turn to the left."""
    route = Route("back", 0, [[0, 0], [10, 0], [0, 0], [0, 5]])
    values = all_three(route, [[12.0, 0.0, 0.0], [13.0, 4.0, 0.5 * np.pi]])
    np.testing.assert_allclose(values[:, 1], [[-2, -5]] * 3, atol=1e-12)
    np.testing.assert_allclose(values[:, 0], 10, atol=1e-12)
    np.testing.assert_allclose(values[:, 2, 1], 0, atol=1e-12)


def test_loop_of_a_square():
    """A closed square has an inside, left of it, and no ends."""
    route = Route("square", 0, SQUARE, closed=True)
    assert route.length == 16.0
    states = [[2, 1, 0], [-1, 2, -0.5 * np.pi], [0, 1, 0], [-3, -4, -0.25 * np.pi]]
    values = all_three(route, states)
    expected = [[2, 14, 15, 0], [1, -1, 0, -5], [0, 0, np.pi / 2, 0]]
    np.testing.assert_allclose(values, [expected] * 3, atol=1e-12)


def test_arc_length_wraps():
    route = Route("square", 0, SQUARE, closed=True)
    s = np.array([0.25, 1.0, 15.5, 16.5, -0.5, 33.0])
    states = route.pose_at(s, 0.1, 0.2)
    arc, error, heading = route.project_numpy(states)
    np.testing.assert_allclose(arc, [0.25, 1, 15.5, 0.5, 15.5, 1], atol=1e-12)
    np.testing.assert_allclose(error, 0.1, atol=1e-12)
    np.testing.assert_allclose(heading, 0.2, atol=1e-12)


def circle(count=720, radius=2.0, turns=1):
    angle = turns * 2 * np.pi * np.arange(count) / count
    points = radius * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    return Route("circle", 0, points, closed=True)


@pytest.mark.parametrize("turns", [1, -1])
def test_heading_and_curvature_of_a_circle(turns):
    route = circle(turns=turns)
    assert route.length == pytest.approx(4 * np.pi, rel=1e-5)
    s = np.linspace(-20, 50, 300)
    turned = route.heading_at(s) - route.heading_at(0.0)
    np.testing.assert_allclose(turned, turns * s / 2, atol=1e-3)
    np.testing.assert_allclose(route.curvature_at(s, 0.3), turns / 2, rtol=1e-3)


def test_heading_of_an_eight_comes_back():
    """Its turns cancel: a lap adds nothing."""
    angle = 2 * np.pi * np.arange(400) / 400
    points = np.stack([3 * np.sin(angle), 2 * np.sin(2 * angle)], axis=1)
    route = Route("eight", 0, points, closed=True)
    s = np.linspace(0, route.length, 50)
    np.testing.assert_allclose(
        route.heading_at(s), route.heading_at(s + route.length), atol=1e-9
    )
    assert np.ptp(route.heading_at(s)) > np.pi


ROUTES = [
    Route("zigzag", 0, ZIGZAG),
    Route("square", 0, SQUARE, closed=True),
    circle(40),
]


def regular_states(route, count=60):
    """Draw states where nothing jumps within a micrometre."""
    rng = np.random.default_rng(4)
    low, high = route.points.min(0) - 3, route.points.max(0) + 3
    place = rng.uniform(low, high, (count, 2))
    states = np.concatenate([place, rng.uniform(-3, 3, (count, 1))], axis=1)
    chosen = []
    for state in states:
        points = route.points.tolist()
        measured, one_place = reference(points, route.closed, *state, within=1e-3)
        (_, _, heading), border = measured[0]
        chosen.append(one_place and border > 1e-3 and abs(heading) < 3)
    return states[np.array(chosen)]


def gradient_drjit(route, name, states):
    state = state64(states.T)
    dr.enable_grad(state)
    dr.backward(dr.sum(getattr(route, name)(state)))
    return dr.grad(state).numpy().T


def gradient_torch(route, name, states):
    state = torch.tensor(states, requires_grad=True)
    getattr(TorchRoute(route), name)(state).sum().backward()
    assert state.grad is not None
    return state.grad.numpy()


@pytest.mark.parametrize("gradient", [gradient_drjit, gradient_torch])
@pytest.mark.parametrize("name", QUANTITIES)
@pytest.mark.parametrize("route", ROUTES, ids=lambda route: route.name)
def test_derivative_by_central_differences(route, name, gradient):
    states = regular_states(route)
    assert len(states) > 20
    found = gradient(route, name, states)
    direction = np.random.default_rng(5).normal(size=states.shape)
    step = 1e-6

    def value(sign):
        return getattr(route.project_numpy(states + sign * step * direction), name)

    slope = (value(1) - value(-1)) / (2 * step)
    np.testing.assert_allclose((found * direction).sum(1), slope, atol=1e-6)


@pytest.mark.parametrize("name", QUANTITIES)
def test_dot_product_identity(name):
    """<w, J v> = <J^T w, v> in Dr.Jit and torch, and both are the same number."""
    route = ROUTES[0]
    states = regular_states(route)
    rng = np.random.default_rng(6)
    v, w = rng.normal(size=states.shape), rng.normal(size=len(states))

    def start():
        state = state64(states.T)
        dr.enable_grad(state)
        return state, getattr(route, name)(state)

    state, value = start()
    dr.set_grad(state, state64(v.T))
    ahead = w @ dr.forward_to(value).numpy()
    state, value = start()
    dr.set_grad(value, type(value)(w))
    dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    back = (dr.grad(state).numpy().T * v).sum()
    function = getattr(TorchRoute(route), name)
    at, tangent, cotangent = (torch.tensor(item) for item in (states, v, w))
    ahead_torch = w @ torch.autograd.functional.jvp(function, at, tangent)[1].numpy()
    pulled = torch.autograd.functional.vjp(function, at, cotangent)[1]
    back_torch = (pulled.numpy() * v).sum()
    np.testing.assert_allclose([back, ahead_torch, back_torch], ahead, rtol=1e-12)


@pytest.mark.parametrize("route", ROUTES, ids=lambda route: route.name)
def test_gradients_are_finite_everywhere(route):
    """Also on the route, on its vertices and on medial axes."""
    points = route.points
    places = np.concatenate([points, (points[1:] + points[:-1]) / 2, [[2.0, 2.0]]])
    states = np.pad(places, ((0, 0), (0, 1)))
    for name in QUANTITIES:
        for gradient in (gradient_drjit, gradient_torch):
            assert np.isfinite(gradient(route, name, states)).all()


def test_single_precision_and_longer_states():
    route = ROUTES[0]
    states = regular_states(route)
    exact = np.array(route.project_numpy(states))
    longer = torch.tensor(np.pad(states, ((0, 0), (0, 2))), dtype=torch.float32)
    single = TorchRoute(route).project(longer)
    assert {item.dtype for item in single} == {torch.float32}
    np.testing.assert_allclose(torch.stack(list(single)), exact, atol=2e-5)
    rows = longer.numpy().T.copy()
    single = route.project(dr.llvm.ad.ArrayXf(rows))
    np.testing.assert_allclose([item.numpy() for item in single], exact, atol=2e-5)


@pytest.mark.parametrize(
    "states", [torch.zeros(3), torch.zeros(4, 2), torch.zeros(4, 3, dtype=torch.int64)]
)
def test_states_of_another_shape(states):
    with pytest.raises(InputError, match=r"states: .*floating-point tensor \(n, 3\)"):
        TorchRoute(ROUTES[0]).cross_track(states)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0, 0], [1, 0]], "at least three"),
        ([[0, 0], [1, 0], [1, 1], [0, 0]], "points 3 and 0 .*returns by itself"),
        ([[0, 0], [1, 0], [1, 0]], "points 1 and 2"),
    ],
)
def test_loops_that_are_none(points, message):
    with pytest.raises(InputError, match=f"route .loop.: .*{message}"):
        Route("loop", 0, points, closed=True)
