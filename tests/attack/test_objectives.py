"""Objectives and reductions against NumPy in double precision."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.reference.derivatives import nothing_compiled

from mi_nerfattack.attack.objectives import (
    AbsoluteDeviation,
    CrossTrackDeviation,
    DepartureTime,
    Discounted,
    End,
    HeadingDeviation,
    LastSeconds,
    Linear,
    Listed,
    TargetDistance,
)
from mi_nerfattack.rollout.objective import (
    CVaR,
    Mean,
    StageSum,
    StateHistory,
    Terminal,
    WeightedSum,
    Worst,
)
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

POINTS = np.array([[0, 0], [10, 0], [14, 3], [14, 12]], np.float64)
ROUTE = Route("lane", 0, POINTS)
TARGET = Route("target", 0, POINTS + [0.0, 1.2])
LIMIT, SOFTNESS, WIDTH, DT = 0.85, 0.25, 0.05, 0.1


def history(states):
    count, horizon, size = states.shape
    kind = dr.llvm.ad.Array3f64 if size == 3 else dr.llvm.ad.ArrayXf64
    rows = kind(states.reshape(-1, size).T.tolist())
    return StateHistory(rows, count, horizon, DT)


def evaluate(objective, states):
    return objective.evaluate(history(states)).numpy()


def gradient(objective, states, cotangent):
    leaf = history(states)
    dr.enable_grad(leaf.rows)
    costs = objective.evaluate(leaf)
    dr.backward(dr.sum(costs * dr.llvm.ad.Float64(cotangent)))
    return dr.grad(leaf.rows).numpy().T.reshape(states.shape)


def tangent(objective, states, direction):
    leaf, along = history(states), history(direction)
    dr.enable_grad(leaf.rows)
    dr.set_grad(leaf.rows, along.rows)
    return dr.forward_to(objective.evaluate(leaf)).numpy()


# --- the same in NumPy, written from the equations ------------------------------------


def cross_track(states, points=POINTS):
    """Distance (...) from a polyline whose ends are prolonged; no sign."""
    position = np.asarray(states)[..., None, :2]
    edge = np.diff(points, axis=0)
    length = np.linalg.norm(edge, axis=1)
    along = ((position - points[:-1]) * edge).sum(-1) / length**2
    low, high = np.zeros(len(edge)), np.ones(len(edge))
    # a prolongation counts only where the end's segment is the nearest one
    miss = position - points[:-1] - np.clip(along, low, high)[..., None] * edge
    nearest = np.argmin(np.linalg.norm(miss, axis=-1), axis=-1)
    low[0], high[-1] = -np.inf, np.inf
    miss = position - points[:-1] - np.clip(along, low, high)[..., None] * edge
    distance = np.linalg.norm(miss, axis=-1)
    return np.take_along_axis(distance, nearest[..., None], -1)[..., 0], nearest


def rounded(value, width):
    return np.sqrt(value**2 + width**2) - width


def heading(states):
    direction = np.arctan2(*np.diff(POINTS, axis=0).T[::-1])
    turn = states[..., 2] - direction[cross_track(states)[1]]
    return np.angle(np.exp(1j * turn))


def departure_time(states, softness):
    margin = (LIMIT - cross_track(states)[0]) / softness
    stay = np.where(margin > 0, 1, np.exp(np.minimum(margin, 0)))
    stay = stay / (1 + np.exp(-np.abs(margin)))
    return DT * np.cumprod(stay, axis=1).sum(1)


CASES = {
    "cross_track": (
        StageSum(CrossTrackDeviation(ROUTE, WIDTH)),
        lambda x: -rounded(cross_track(x)[0], WIDTH).sum(1),
    ),
    "absolute": (
        StageSum(AbsoluteDeviation(ROUTE)),
        lambda x: -cross_track(x)[0].sum(1),
    ),
    "terminal": (
        Terminal(CrossTrackDeviation(ROUTE, WIDTH)),
        lambda x: -rounded(cross_track(x[:, -1])[0], WIDTH),
    ),
    "terminal_absolute": (
        Terminal(AbsoluteDeviation(ROUTE)),
        lambda x: -cross_track(x[:, -1])[0],
    ),
    "heading": (
        StageSum(HeadingDeviation(ROUTE, 0.02)),
        lambda x: -rounded(heading(x), 0.02).sum(1),
    ),
    "target": (
        StageSum(TargetDistance(TARGET, WIDTH)),
        lambda x: rounded(cross_track(x, TARGET.points)[0], WIDTH).sum(1),
    ),
    "departure": (
        DepartureTime(ROUTE, LIMIT, SOFTNESS),
        lambda x: departure_time(x, SOFTNESS),
    ),
    "sum": (
        WeightedSum(
            (
                (0.5, DepartureTime(ROUTE, LIMIT, SOFTNESS)),
                (-2.0, Terminal(HeadingDeviation(ROUTE, 0.02))),
            )
        ),
        lambda x: (
            0.5 * departure_time(x, SOFTNESS) + 2 * rounded(heading(x[:, -1]), 0.02)
        ),
    ),
}


def drives(rng, count, horizon, size=3):
    """Random states beside the route, also before its start and past its end."""
    arc = rng.uniform(-3, ROUTE.length + 3, count * horizon)
    lateral = rng.choice([-1, 1], arc.shape) * rng.uniform(0.05, 1.5, arc.shape)
    states = ROUTE.pose_at(arc, lateral, rng.normal(0, 0.5, arc.shape))
    extra = rng.normal(size=(len(states), size - 3))
    return np.concatenate([states, extra], axis=1).reshape(count, horizon, size)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("count", "horizon", "size"), [(3, 7, 3), (1, 1, 3), (1, 5, 4), (4, 1, 5)]
)
def test_values(name, count, horizon, size, rng):
    objective, expected = CASES[name]
    states = drives(rng, count, horizon, size)
    value = evaluate(objective, states)
    assert value.shape == (count,)
    np.testing.assert_allclose(value, expected(states), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("count", "horizon", "size"), [(3, 7, 3), (1, 1, 3), (2, 4, 4)]
)
def test_derivatives(name, count, horizon, size, rng):
    objective, expected = CASES[name]
    states = drives(rng, count, horizon, size)
    cotangent = rng.uniform(0.5, 1.5, count)
    derivative = gradient(objective, states, cotangent)
    direction = rng.normal(size=states.shape)

    def along(step):
        return (cotangent * expected(states + step * direction)).sum()

    coarse = (along(1e-4) - along(-1e-4)) / 2e-4
    fine = (along(5e-5) - along(-5e-5)) / 1e-4
    product = (derivative * direction).sum()
    assert product == pytest.approx((4 * fine - coarse) / 3, rel=1e-7)
    pushed = (cotangent * tangent(objective, states, direction)).sum()
    assert pushed == pytest.approx(product, rel=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_lane_centre(name):
    """Values are those of the equations, derivatives finite, on the lane centre."""
    states = ROUTE.pose_at(np.array([[2.0, 3.0, 25.0]]))
    objective, expected = CASES[name]
    np.testing.assert_allclose(
        evaluate(objective, states), expected(states), rtol=1e-9, atol=1e-14
    )
    derivative = gradient(objective, states, [1.0])
    if name == "target":
        assert np.abs(derivative[0, :, 1]).max() > 0.5
    else:
        np.testing.assert_allclose(derivative, 0, atol=1e-12)


def test_medial_axis():
    """Where two segments are equally near, the derivative is that of one of them."""
    bend = Route("bend", 0, [[0, 0], [10, 0], [10, 10]])
    states = np.array([[[9.0, 1.0, 0.0], [8.5, 1.5, 0.0]]])
    objective = StageSum(AbsoluteDeviation(bend))
    assert evaluate(objective, states)[0] == pytest.approx(-2.5, abs=1e-15)
    for derivative in gradient(objective, states, [1.0])[0]:
        assert derivative.tolist() in ([0, -1, 0], [1, 0, 0])


def test_heading_against_the_lane():
    """Facing backwards the value is pi less rounding, its derivative of length 1."""
    objective = StageSum(HeadingDeviation(ROUTE, 0.02))
    states = np.array([[[5.0, 0.3, np.pi]], [[5.0, 0.3, -np.pi]]])
    value = evaluate(objective, states)
    np.testing.assert_allclose(value, -rounded(np.pi, 0.02), rtol=1e-12)
    derivative = gradient(objective, states, [1.0, 1.0])
    np.testing.assert_allclose(np.abs(derivative[..., 2]), 1, rtol=1e-4)
    assert not derivative[..., :2].any()


@pytest.mark.parametrize("first", [1, 2, 4, 6, None])
def test_departure_time_becomes_exact(first):
    """Without softness it is the time of the last state inside the limit."""
    lateral = np.full(6, 0.3)
    if first is not None:
        lateral[first - 1] = -1.2  # leaves to the right, and comes back
    states = ROUTE.pose_at(np.linspace(0, 5, 6), lateral)[None]
    exact = DT * (6 if first is None else first - 1)
    for softness in (0.1, 0.05, 0.02, 1e-3):
        departure = evaluate(DepartureTime(ROUTE, LIMIT, softness), states)[0]
        # the margin is 0.35 m on both sides; a period's chance is off by less
        bound = DT * 6 * 6 * np.exp(-0.35 / softness)
        assert abs(departure - exact) <= bound + 1e-15


def test_departure_time_far_out_is_finite():
    states = np.array([[[5.0, 1e6, 0.0], [6.0, -1e6, 0.0]]])
    objective = DepartureTime(ROUTE, LIMIT, 1e-3)
    assert evaluate(objective, states)[0] == 0
    assert not gradient(objective, states, [1.0]).any()


def test_history_of_time(rng):
    states = drives(rng, 2, 3)
    recorded = history(states)
    np.testing.assert_allclose(recorded.time.numpy(), [0.1, 0.2, 0.3] * 2, rtol=1e-15)
    np.testing.assert_array_equal(recorded.final.numpy().T, states[:, -1])


def test_no_kernel_is_compiled_twice(rng):
    """Other states, as in the next iteration of an attack, run the same kernels."""
    weighted = StageSum(AbsoluteDeviation(ROUTE), Linear().of(5, 0.1))
    objective = WeightedSum(((1.0, CASES["sum"][0]), (2.0, weighted)))

    def differentiate():
        leaf = history(drives(rng, 4, 5))
        dr.enable_grad(leaf.rows)
        dr.backward(CVaR(0.3).reduce(objective.evaluate(leaf)))
        dr.eval(dr.grad(leaf.rows))

    differentiate()
    with nothing_compiled():
        differentiate()


# --- weights of the horizon -----------------------------------------------------------


def test_weights(rng):
    np.testing.assert_allclose(Linear().of(4, 0.1), [0.25, 0.5, 0.75, 1])
    assert LastSeconds(0.2).of(5, 0.1).tolist() == [0, 0, 0, 1, 1]
    assert LastSeconds(0.3).of(5, 0.1).sum() == 3  # 0.3 / 0.1 is below 3
    assert LastSeconds(0.1).of(1, 0.1).tolist() == [1]
    np.testing.assert_allclose(Discounted(0.25).of(3, 0.5), [1, 0.5, 0.25])
    assert Listed((0.0, -1.5)).of(2, 0.1).tolist() == [0, -1.5]
    assert End().of(3, 0.1).tolist() == [0, 0, 1]
    states, weights = drives(rng, 3, 5), rng.normal(size=5)
    costs = evaluate(StageSum(AbsoluteDeviation(ROUTE), weights), states)
    np.testing.assert_allclose(costs, -(weights * cross_track(states)[0]).sum(1))


test_unusable_values_are_named = refusals(
    (lambda: LastSeconds(0.6).of(5, 0.1), "0.6 s is 6 "),
    (lambda: LastSeconds(0.01).of(5, 0.1), "0 control periods"),
    (lambda: Discounted(1.5), "discount_per_s: 1.5"),
    (lambda: Listed((1.0, 2.0)).of(3, 0.1), "2 .* 3"),
    (lambda: Listed((0.0, 0.0)).of(2, 0.1), "zero"),
    (lambda: Listed((0.0, np.nan)), "finite"),
    (lambda: WeightedSum(()), "at least one"),
    (lambda: CVaR(0.0), "CVaR.fraction: 0"),
    (lambda: CVaR(1.5), "CVaR.fraction: 1.5"),
    (lambda: DepartureTime(ROUTE, -1.0), "limit_m: -1"),
    (lambda: CrossTrackDeviation(ROUTE, 0.0), "rounding_m: 0"),
    (
        lambda: evaluate(
            StageSum(AbsoluteDeviation(ROUTE), np.ones(4)), np.zeros((1, 5, 3))
        ),
        r"\(5,\)",
    ),
)


# --- reductions -----------------------------------------------------------------------


def reduce(reduction, costs):
    leaf = dr.llvm.ad.Float64(np.asarray(costs, np.float64))
    dr.enable_grad(leaf)
    value = reduction.reduce(leaf)
    dr.backward(value)
    assert dr.width(value) == 1
    return value.numpy()[0], dr.grad(leaf).numpy()


def cvar(costs, fraction):
    """Rockafellar and Uryasev: the minimum over z of z + E[max(c - z, 0)] / f."""
    return min(z + np.maximum(costs - z, 0).mean() / fraction for z in costs)


@pytest.mark.parametrize("fraction", [0.01, 0.2, 0.25, 0.37, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("count", [1, 4, 9])
def test_cvar(fraction, count, rng):
    costs = rng.normal(size=count)
    value, derivative = reduce(CVaR(fraction), costs)
    assert value == pytest.approx(cvar(costs, fraction), rel=1e-12)
    direction = rng.normal(size=count)
    up, down = (cvar(costs + s * 1e-6 * direction, fraction) for s in (1, -1))
    assert derivative @ direction == pytest.approx(
        (up - down) / 2e-6, rel=1e-7, abs=1e-9
    )
    assert derivative.sum() == pytest.approx(1, rel=1e-12)


def test_mean_and_worst(rng):
    costs = rng.normal(size=5)
    value, derivative = reduce(Worst(), costs)
    assert value == pytest.approx(costs.max(), rel=1e-15)
    assert derivative.tolist() == (costs == costs.max()).astype(float).tolist()
    value, derivative = reduce(Mean(), costs)
    assert value == pytest.approx(costs.mean(), rel=1e-14)
    np.testing.assert_allclose(derivative, 0.2)


@pytest.mark.parametrize("reduction", [Mean(), CVaR(0.3), CVaR(0.05), Worst()])
def test_equal_costs_share_the_derivative(reduction):
    value, derivative = reduce(reduction, [-2.0] * 4)
    assert value == pytest.approx(-2, rel=1e-15)
    np.testing.assert_allclose(derivative, 0.25, rtol=1e-15)
    value, derivative = reduce(reduction, [-2.0])
    assert value == -2 and derivative.tolist() == [1]


def test_ties_at_the_quantile_share_the_rest():
    value, derivative = reduce(CVaR(0.5), [3.0, 1.0, 1.0, 0.0])
    assert value == pytest.approx(2.0)
    np.testing.assert_allclose(derivative, [0.5, 0.25, 0.25, 0])
    _, derivative = reduce(Worst(), [1.0, 3.0, 3.0])
    np.testing.assert_allclose(derivative, [0, 0.5, 0.5])


def test_reductions_hide_no_nan():
    for reduction in (Mean(), CVaR(0.5), Worst()):
        assert np.isnan(reduce(reduction, [1.0, np.nan, 2.0])[0])
