"""Bounds by smoothing where the truth is known; gradients whose angle is known."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from mi_nerfattack.evaluation.certificate import (
    agreement,
    bound_within,
    chance_bound,
    chance_interval,
)

SD = 0.4


@pytest.mark.parametrize(("count", "total"), [(0, 60), (3, 60), (59, 60)])
def test_exact_bounds_leave_out_what_is_as_unlikely_as_was_said(count, total):
    bound = chance_bound(count, total, 0.999)
    assert scipy.stats.binom.cdf(count, total, bound) == pytest.approx(0.001)
    low, high = chance_interval(count, total, 0.98)
    assert scipy.stats.binom.cdf(count, total, high) == pytest.approx(0.01)
    if count:
        assert scipy.stats.binom.sf(count - 1, total, low) == pytest.approx(0.01)
    else:
        assert low == 0.0


def test_all_or_none_of_the_drives():
    assert chance_bound(40, 40, 0.999) == 1.0
    # none of n: the chance p with (1 - p)^n = 0.001
    assert chance_bound(0, 40, 0.999) == pytest.approx(1 - 0.001 ** (1 / 40))
    assert bound_within(1.0, 0.3, SD) == 1.0
    assert bound_within(0.2, 0.0, SD) == pytest.approx(0.2)


def half_space(normal: np.ndarray, offset: float, point: np.ndarray) -> float:
    """Return the exact chance that ``normal . (point + noise) > offset``."""
    length = np.linalg.norm(normal)
    return scipy.stats.norm.cdf((normal @ point - offset) / (SD * length))


def test_the_bound_is_reached_by_a_half_space_and_by_no_other_direction():
    rng = np.random.default_rng(0)
    normal, offset = rng.standard_normal(24), 2.0
    chance = half_space(normal, offset, np.zeros(24))
    for radius in (0.1, 0.4, 1.0):
        bound = bound_within(chance, radius, SD)
        worst = radius * normal / np.linalg.norm(normal)
        assert half_space(normal, offset, worst) == pytest.approx(bound)
        others = rng.standard_normal((50, 24))
        others *= radius / np.linalg.norm(others, axis=1, keepdims=True)
        assert max(half_space(normal, offset, other) for other in others) < bound


@pytest.mark.parametrize("inside", [True, False])
def test_the_bound_holds_for_departures_in_a_ball_and_around_it(inside):
    # |z + noise|^2 / sd^2 has a noncentral chi-square distribution
    dimension, limit = 6, 1.2
    name = "cdf" if inside else "sf"

    def chance(distance: float) -> float:
        law = scipy.stats.ncx2(dimension, (distance / SD) ** 2)
        return getattr(law, name)((limit / SD) ** 2)

    for start in (0.3, 0.8, 1.5):
        for end in np.linspace(0.05, 3, 40):
            bound = bound_within(chance(start), abs(end - start), SD)
            assert chance(end) <= bound + 1e-9


@pytest.mark.parametrize("confidence", [0.9, 0.999])
@pytest.mark.parametrize("chance", [0.001, 0.02, 0.3, 0.9])
def test_bounds_fail_as_seldom_as_was_said(chance, confidence):
    """Sum the probabilities of all numbers of departures whose bound is too low."""
    drives, normal = 200, np.array([3.0, 4.0])
    offset = -5 * SD * scipy.stats.norm.ppf(chance)
    counts = np.arange(drives + 1)
    odds = scipy.stats.binom.pmf(counts, drives, chance)
    worst = 0.5 * normal / 5
    truth = half_space(normal, offset, worst)
    bounds = [
        bound_within(chance_bound(count, drives, confidence), 0.5, SD)
        for count in counts
    ]
    failed = odds[np.array(bounds) < truth - 1e-12].sum()
    assert failed <= 1 - confidence
    # and it is no more careful than whole numbers make it
    at_most = scipy.stats.binom.cdf(counts, drives, chance)
    assert failed == pytest.approx(odds[at_most < 1 - confidence].sum(), abs=1e-12)


def test_bounds_by_drawn_drives_fail_as_seldom_as_was_said():
    """The same by simulation: drives are drawn, counted, and their bound compared."""
    rng, repeats, drives, confidence = np.random.default_rng(1), 3000, 100, 0.9
    normal, offset = np.array([1.0, -2.0, 2.0]), 1.0
    noise = SD * rng.standard_normal((repeats, drives, 3))
    departed = (noise @ normal > offset).sum(axis=1)
    truth = half_space(normal, offset, 0.3 * normal / 3)
    known = {
        count: bound_within(chance_bound(count, drives, confidence), 0.3, SD)
        for count in set(departed.tolist())
    }
    failed = np.mean([known[count] < truth for count in departed.tolist()])
    assert 0.02 < failed < 0.1 + 3 * np.sqrt(0.09 / repeats)


def changes(rng, n: int, cosine: float, slope: float):
    """Return changes by two gradients at a known angle, along normal directions."""
    predicts = np.eye(40)[0]
    real = slope * predicts + np.eye(40)[1] * slope * np.tan(np.arccos(cosine))
    directions = 0.1 * rng.standard_normal((n, 40))
    return directions @ predicts, directions @ real


def test_slope_and_cosine_are_those_of_the_gradients():
    rng = np.random.default_rng(2)
    estimate = agreement(*changes(rng, 20_000, 0.8, 0.7))
    assert estimate.cosine == pytest.approx(0.8, abs=0.01)
    assert estimate.slope == pytest.approx(0.7, abs=0.02)
    same = agreement(*changes(rng, 8, 1.0, 1.3))
    assert same.slope == pytest.approx(1.3) and same.cosine == pytest.approx(1.0)
    assert same.is_true
    assert not agreement(*changes(rng, 32, 0.1, 1.0)).is_true
    assert not agreement(*changes(rng, 32, 1.0, 0.3)).is_true  # a third of the gain
    assert agreement(np.zeros(5), np.ones(5)) is None
    assert agreement(np.ones(5), np.zeros(5)) is None


def test_intervals_of_slope_and_cosine_hold_the_truth():
    rng, repeats = np.random.default_rng(3), 1500
    held = np.zeros(2)
    for _ in range(repeats):
        estimate = agreement(*changes(rng, 32, 0.6, 1.0))
        pairs = (estimate.slope_ci95, 1.0), (estimate.cosine_ci95, 0.6)
        held += [low <= truth <= high for (low, high), truth in pairs]
    assert (abs(held / repeats - 0.95) < 0.02).all(), held / repeats
