"""Paired comparisons of made drives whose figures are known by hand."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from support.files.runs import make_document, make_drive

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import drives_of_run
from mi_nerfattack.evaluation.pairs import compare, compare_departures
from mi_nerfattack.evaluation.summary import (
    FEW,
    RESAMPLES,
    interquartile_mean,
    interval,
    mean_interval,
    summary,
)

ERROR, OUT = "cross_track_mean_m", "wheel_out_s"

#: Mean errors by scenario and seed: of two starts attacked, and of the same unattacked.
ERRORS = {
    ("bend", 0): ([0.4, 0.6], [0.1, 0.1]),  # 0.5 - 0.1 = 0.4
    ("bend", 1): ([0.7, 0.7], [0.2, 0.0]),  # 0.7 - 0.1 = 0.6
    ("lane", 0): ([0.3, 0.3], [0.1, 0.1]),  # 0.3 - 0.1 = 0.2
    ("lane", 1): ([1.6, 2.4], [0.4, 0.4]),  # 2.0 - 0.4 = 1.6
}


COLUMNS = ["scenario", "seed", "environment", "case", "run", "start", ERROR]


def table(*rows, figure=ERROR):
    return pd.DataFrame(list(rows), columns=[*COLUMNS[:-1], figure])


def side(number: int, figure: str = ERROR, errors=None) -> pd.DataFrame:
    case = ("attack", "own")[number]
    rows = [
        (name, seed, "surrogate", case, run, run, value)
        for (name, seed), sides in (ERRORS if errors is None else errors).items()
        for run, value in enumerate(sides[number])
    ]
    return table(*rows, figure=figure)


def test_effect_by_hand():
    effect = compare(side(0)[::-1], side(1), ERROR)
    assert (effect.attacks, effect.drives, effect.unpaired) == (4, 8, 0)
    assert effect.seeds == 2
    assert effect.one == pytest.approx(3.5 / 4)
    assert effect.other == pytest.approx(0.7 / 4)
    assert effect.difference == pytest.approx(2.8 / 4)
    assert effect.iqm == pytest.approx((0.4 + 0.6) / 2)  # without 0.2 and 1.6
    assert effect.ratio == pytest.approx(5)
    # bend: 0.4 and 0.6, squares about their mean 0.02; lane: 0.2 and 1.6, 0.98; of
    # one degree of freedom each
    assert effect.spread == pytest.approx(math.sqrt((0.02 + 0.98) / 2))


def test_intervals_of_few_attacks_are_students_t():
    """Five differences -1 to 3, by the textbook; the ratio on its logarithm."""
    errors = {("bend", k): ([k + 1.0], [2.0]) for k in range(5)}
    effect = compare(side(0, errors=errors), side(1, errors=errors), ERROR)
    half = 2.7764451 * math.sqrt(2.5 / 5)  # t of 4 degrees of freedom, sd^2 = 2.5
    assert effect.difference_ci95 == pytest.approx([1 - half, 1 + half])
    left = np.log([(15 - k) / 8 for k in range(1, 6)])  # without each
    half = 2.7764451 * math.sqrt(4 / 5 * ((left - left.mean()) ** 2).sum())
    ends = [1.5 * math.exp(-half), 1.5 * math.exp(half)]
    assert effect.ratio_ci95 == pytest.approx(ends)


def test_looks_of_one_start_are_averaged_and_strays_left_out():
    attack = table(
        ("bend", 0, "surrogate", "attack", 0, 0, 0.5),
        ("bend", 7, "surrogate", "attack", 0, 0, 9.0),
    )
    looks = table(
        *(
            ("bend", 0, "surrogate", "random", run, run % 2, value)
            for run, value in enumerate([0.1, 8.0, 0.3])
        )
    )
    effect = compare(attack, looks, ERROR)
    assert (effect.attacks, effect.drives, effect.unpaired) == (1, 1, 2)
    assert (effect.one, effect.other) == (0.5, pytest.approx(0.2))


@pytest.mark.parametrize("count", [1, 4])
def test_few_attacks_have_no_intervals(count):
    errors = {("bend", k): ([0.4 + k, 0.6], [0.1, 0.1]) for k in range(count)}
    sides = side(0, errors=errors), side(1, errors=errors)
    effect, left = compare(*sides, ERROR), compare_departures(*sides, ERROR)
    intervals = effect.difference_ci95, effect.iqm_ci95, effect.ratio_ci95
    assert intervals == (None, None, None)
    assert (left.one_ci95, left.other_ci95) == (None, None)
    assert (effect.spread is None) == (count == 1)


def test_equal_attacks_give_points_and_nothing_has_no_ratio():
    errors = {("bend", seed): ([0.75], [0.25]) for seed in range(5)}
    effect = compare(side(0, errors=errors), side(1, errors=errors), ERROR)
    assert effect.difference_ci95 == effect.iqm_ci95 == [0.5, 0.5]
    assert effect.ratio_ci95 == [3, 3] and (effect.spread, effect.seeds) == (0, 5)
    errors["bend", 4] = [0.5], [0.0]
    effect = compare(side(0, errors=errors), side(1, errors=errors), ERROR)
    assert (effect.ratio, effect.ratio_ci95) == (None, None)


def test_one_that_differs_does_not_tell_the_interval_of_the_quartiles():
    values = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    assert interquartile_mean(values) == 0
    assert interval(interquartile_mean, (values,), 0) is None
    assert interval(np.mean, (values,), 0) is not None
    # Without the one there is no logarithm: Student's interval, which ends at 0
    half = 2.7764451 * math.sqrt(0.2 / 5)
    assert mean_interval(values, 0) == pytest.approx([0, 0.2 + half])
    # A logarithm whose error spans orders of magnitude is not taken, either
    values = np.array([0.05, 0.06, 0.05, 0.07, 5.5])
    half = 2.7764451 * float(np.std(values, ddof=1)) / math.sqrt(5)
    ends = [max(values.mean() - half, 0), values.mean() + half]
    assert mean_interval(values, 0) == pytest.approx(ends)
    assert interquartile_mean(np.array([0.0, 0.0, 3.0])) == 1  # no quarter of three


def test_departures_by_hand():
    """Of eight attacks, five depart under attack alone, and one on both sides."""
    errors = {("bend", seed): ([0.5, 1.5], [0.0, 0.9]) for seed in range(5)}
    errors |= {("lane", 0): ([3.0], [1.0]), ("lane", 1): ([0.9], [0.9])}
    errors["lane", 2] = [0.0, 1.9], [0.0, 0.0]  # once, but not on average
    sides = side(0, OUT, errors), side(1, OUT, errors)
    departures = compare_departures(*sides)
    assert (departures.both, departures.one, departures.other, departures.neither) == (
        1,
        5,
        0,
        2,
    )
    assert departures.p_value == pytest.approx(2 / 2**5)  # five of five, either way
    ends = scipy.stats.binomtest(6, 8).proportion_ci(method="wilson")
    assert departures.one_ci95 == pytest.approx(list(ends))
    assert departures.other_ci95[0] < 1 / 8 < departures.other_ci95[1]
    assert compare_departures(sides[1], sides[0]).p_value == departures.p_value
    assert compare_departures(sides[0], sides[0]).p_value is None  # none differ
    assert compare_departures(*sides, least=0.2).both == 7


@pytest.mark.parametrize("starts", [1, 2])
def test_several_drives_of_an_attack_give_no_interval_of_departures(starts):
    rows = [(k, 0.1, 0.0, k < 2) for k in range(6) for _ in range(starts)]
    drives = pd.DataFrame(rows, columns=["attack", ERROR, OUT, "departed"])
    figures = summary(drives.assign(case="attack"), ["case"], ["attack"]).iloc[0]
    assert figures["drives_departed"] == 2 * starts
    ends = scipy.stats.binomtest(2, 6).proportion_ci(method="wilson")
    expected = pytest.approx(list(ends)) if starts == 1 else None
    assert figures["departure_rate_ci95"] == expected


def test_a_run_gives_its_drives_with_their_starts():
    drives = [make_drive([0.1], case="own", run=k) for k in range(2)]
    drives += [make_drive([0.2 + 0.1 * k], case="random", run=k) for k in range(3)]
    rows = drives_of_run(make_document(drives))
    own, random = (rows[rows["case"] == case] for case in ("own", "random"))
    names = ["scenario", "seed", "environment", "run", "start", "drive_seed"]
    assert random[names].to_numpy().tolist() == [
        ["x", 7, "surrogate", 0, 0, 100],
        ["x", 7, "surrogate", 1, 1, 101],
        ["x", 7, "surrogate", 2, 0, 102],
    ]
    assert random[ERROR].tolist() == pytest.approx([0.2, 0.3, 0.4])
    assert own["start"].tolist() == [0, 1] and not rows["departed"].any()
    effect = compare(random, own, ERROR)
    assert effect.difference == pytest.approx((0.2 + 0.2) / 2)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"case": "random"}, "surrogate / attack, surrogate / random"),
        ({"run": 0}, "bend, seed 0, run 0: "),
        ({ERROR: math.nan}, f"bend, seed 0, run 1: {ERROR} is nan"),
    ],
)
def test_sides_that_cannot_be_compared_are_refused(change, named):
    drive = table(("bend", 0, "surrogate", "attack", 0, 0, 0.5))
    second = drive.assign(**{"run": 1, "start": 1, **change})
    with pytest.raises(InputError, match=named):
        compare(pd.concat([drive, second]), drive, ERROR)
    with pytest.raises(InputError, match="moon.* scenario, seed"):
        compare(drive, drive, "moon")
    with pytest.raises(InputError, match="1 starts on one side, 0 on the other"):
        compare(drive, drive[:0], ERROR)


#: Share of the 95 % intervals that hold the mean, by how many values they are of: of
#: values that are normal, lognormal, and mostly alike with one in ten that is ten times
#: as large; the t interval on a logarithm, and BCa. docs/explain/intervals.md has it.
COVERAGE = {
    5: ((0.95, 0.85), (0.91, 0.77), (0.44, 0.40)),
    6: ((0.95, 0.86), (0.91, 0.81), (0.48, 0.46)),
    7: ((0.96, 0.87), (0.91, 0.81), (0.51, 0.50)),
    8: ((0.95, 0.88), (0.92, 0.84), (0.56, 0.55)),
    10: ((0.95, 0.90), (0.92, 0.85), (0.64, 0.64)),
    15: ((0.96, 0.92), (0.93, 0.89), (0.78, 0.78)),
}


def drawn(rng: np.random.Generator, shape: tuple[int, int]):
    """Yield values (..., n) of the three distributions, and their means."""
    yield np.abs(rng.normal(1.0, 0.3, shape)), 1.0
    yield rng.lognormal(0.0, 0.8, shape), math.exp(0.32)
    few = np.where(rng.random(shape) < 0.1, 10, 1)
    yield few * rng.lognormal(0.0, 0.3, shape), 1.9 * math.exp(0.045)


def coverage(count: int, repeats: int = 2000) -> list[tuple[float, float]]:
    """Return the share of t and of BCa intervals that hold the mean."""
    shares = []
    for values, mean in drawn(np.random.default_rng(count), (repeats, count)):
        few = np.array([mean_interval(row, 0) for row in values])
        bca = [
            scipy.stats.bootstrap((part,), np.mean, axis=-1, n_resamples=1999)
            for part in np.array_split(values, 20)
        ]
        low, high = (
            np.concatenate([part.confidence_interval[k] for part in bca])
            for k in (0, 1)
        )
        held = (few[:, 0] <= mean) & (mean <= few[:, 1]), (low <= mean) & (mean <= high)
        shares.append((float(held[0].mean()), float(held[1].mean())))
    return shares


@pytest.mark.slow
@pytest.mark.parametrize("count", COVERAGE)
def test_intervals_of_few_hold_the_mean_as_often_as_the_docs_say(count):
    assert count <= FEW and RESAMPLES > 1999
    np.testing.assert_allclose(coverage(count), COVERAGE[count], atol=0.025)
