"""Routes: their files, and projection in NumPy and Dr.Jit against a loop."""

from __future__ import annotations

import json
import math

import drjit as dr
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from support.faults.refusals import refusals
from support.reference.derivatives import row64, state64

from mi_nerfattack.vehicle import Route, load_routes, smooth_absolute

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
    feet = []
    for i in range(count):
        (ax, ay), (bx, by) = points[i], points[(i + 1) % n]
        tx, ty = (bx - ax) / lengths[i], (by - ay) / lengths[i]
        along = (x - ax) * tx + (y - ay) * ty
        foot = min(max(along, 0.0), lengths[i])
        miss = math.hypot(x - ax - foot * tx, y - ay - foot * ty)
        feet.append((miss, sum(lengths[:i]) + foot, i, along, (tx, ty)))
    feet.sort(key=lambda entry: entry[0])
    least, first_arc = feet[0][:2]
    feet = [entry for entry in feet if entry[0] < least + within]
    apart = [abs(entry[1] - first_arc) for entry in feet]
    if closed:
        apart = [min(gap, sum(lengths) - gap) for gap in apart]
    measured = []
    for miss, arc, i, along, (tx, ty) in feet:
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


def both(route, states):
    """Return the measures of each implementation, (2 implementations, 3, n)."""
    by_drjit = [item.numpy() for item in route.project(state64(np.transpose(states)))]
    return np.array([list(route.project_numpy(states)), by_drjit])


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
def test_both_implementations_agree_with_a_loop(points, closed, places):
    after = points[1:] + points[:1] if closed else points[1:]
    assume(all(a != b for a, b in zip(points, after, strict=False)))
    route = Route("random", 0, points, closed=closed)
    # beside the drawn places: all vertices, and past both ends
    last = route.length
    beyond = route.pose_at([-3.0, -1.0, last + 1.0, last + 3.0], 0.7, 0.1).tolist()
    states = np.array([*places, *((x, y, 0.3) for x, y in points), *beyond])
    values = both(route, states)
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
    _, errors, _ = both(route, [[x, y, 0.0]]).T[0]
    distance = math.hypot(x - 10, y) if offset > 0 else abs(offset)
    expected = -math.copysign(distance, offset)
    np.testing.assert_allclose(errors, expected, atol=1e-3)
    assert (np.sign(errors) == np.sign(expected)).all()


def test_complete_reversal():
    """There and back again: beyond the end is right of a turn to the left."""
    route = Route("back", 0, [[0, 0], [10, 0], [0, 0], [0, 5]])
    values = both(route, [[12.0, 0.0, 0.0], [13.0, 4.0, 0.5 * np.pi]])
    np.testing.assert_allclose(values[:, 1], [[-2, -5]] * 2, atol=1e-12)
    np.testing.assert_allclose(values[:, 0], 10, atol=1e-12)
    np.testing.assert_allclose(values[:, 2, 1], 0, atol=1e-12)


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
    square = Route("square", 0, SQUARE, closed=True)  # the arc length wraps
    s = np.array([0.25, 1.0, 15.5, 16.5, -0.5, 33.0])
    projection = square.project_numpy(square.pose_at(s, 0.1, 0.2))
    expected = [[0.25, 1, 15.5, 0.5, 15.5, 1], [0.1] * 6, [0.2] * 6]
    np.testing.assert_allclose(projection, expected, atol=1e-12)


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


@pytest.mark.parametrize("name", QUANTITIES)
@pytest.mark.parametrize("route", ROUTES, ids=lambda route: route.name)
def test_derivative_by_central_differences(route, name):
    states = regular_states(route)
    assert len(states) > 20
    gradient = gradient_drjit(route, name, states)
    direction = np.random.default_rng(5).normal(size=states.shape)
    step = 1e-6

    def value(sign):
        return getattr(route.project_numpy(states + sign * step * direction), name)

    slope = (value(1) - value(-1)) / (2 * step)
    np.testing.assert_allclose((gradient * direction).sum(1), slope, atol=1e-6)


@pytest.mark.parametrize("route", ROUTES, ids=lambda route: route.name)
def test_gradients_are_finite_everywhere(route):
    """Also on the route, on its vertices and on medial axes."""
    points = route.points
    places = np.concatenate([points, (points[1:] + points[:-1]) / 2, [[2.0, 2.0]]])
    states = np.pad(places, ((0, 0), (0, 1)))
    for name in QUANTITIES:
        assert np.isfinite(gradient_drjit(route, name, states)).all()


def test_pose_at_inverts_projection():
    route = Route("lane", 0, [[0, 0], [15, 0], [15, -8], [40, -8]])
    s = np.array([-3.0, 0.0, 7.3, 19.0, 60.0])
    states = route.pose_at(s, [0.4, -0.3, 1.0, -1.0, 0.2], 0.2)
    arc, error, heading = route.project_numpy(states)
    np.testing.assert_allclose(arc, s, atol=1e-12)
    np.testing.assert_allclose(error, [0.4, -0.3, 1.0, -1.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(heading, 0.2, atol=1e-12)
    assert route.pose_at(2.0).shape == (3,) and route.length == 48
    # in single precision, and with the rows of a longer state
    rows = np.pad(states, ((0, 0), (0, 2))).T.astype(np.float32)
    single = [item.numpy() for item in route.project(dr.llvm.ad.ArrayXf(rows))]
    np.testing.assert_allclose(single, [arc, error, heading], atol=2e-5)


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
    (route,) = load_routes(write_routes(tmp_path, **loop))
    assert route.closed and route.length == pytest.approx(2 + 2**0.5)


def changed(name="right", **changes):
    return lambda folder: Route.from_file(write_routes(folder, **changes), name)


test_route_file_errors = refusals(
    (changed("left"), "routes.json: .*'left'; it has 'right'"),
    (lambda folder: Route.from_file(folder / "absent.json", "left"), "absent"),
    (lambda folder: load_routes(folder / "track.csv"), "track.csv: .*JSON.*points_m"),
    (changed(points_m=[[0, 0], [1, 1], [1, 1]]), "routes.json.*points 1 and 2"),
    (changed(points_m=[[0, 0], [1, 1e10]]), "routes.json.*point 1 .* 1e.09 m"),
    (changed(goal=-1), "routes.json.*goal"),
    (changed(closed=1), "routes.json.*closed 1"),
    (changed(points_m=[[0, 0], [1, 0], [1, 1], [0, 0]], closed=True), "points 3 and 0"),
)
