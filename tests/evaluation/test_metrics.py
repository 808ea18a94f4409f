"""Figures of drives by hand, and the document that holds them."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from helpers.made_drives import COST, LANES, make_document, make_drive

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation import metrics
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import CASES, departure_limit

# Drives and the departure limit


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": ""}, "environment: ''; must be a name, not empty"),
        ({"case": "bayes"}, "case: 'bayes'"),
        ({"route": ""}, "route"),
        ({"run": -1}, "run: -1"),
        ({"states": np.zeros((2, 3))}, r"states: shape \(2, 3\); must be \(3, 3\)"),
        ({"time_s": np.array([0.1])}, "time_s: shape"),
        ({"time_s": np.array([0.2, 0.1])}, "time_s: not increasing"),
        ({"controls": np.array([0.0, np.nan])}, "controls: value at index 1"),
        ({"controls": np.zeros(0)}, "controls: no step"),
    ],
)
def test_drive_refuses_bad_records(changes, message):
    with pytest.raises(InputError, match=message):
        make_drive([0.1, 0.2], **changes)


def test_drive_keeps_read_only_copies():
    errors = np.array([0.1, 0.2])
    drive = make_drive([0.1, 0.2], cross_track_m=errors)
    errors[0] = 5
    assert drive.cross_track_m[0] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        drive.states[0, 0] = 1


def test_departure_limit():
    assert departure_limit(3.5, 1.8) == pytest.approx(0.85, abs=1e-15)
    for lane, car in ((1.8, 1.8), (3.5, 0.0), (np.nan, 1.0), (np.inf, 1.0)):
        with pytest.raises(InputError, match="car_width_m"):
            departure_limit(lane, car)


def test_step_at_the_limit_has_not_departed():
    above = float(np.nextafter(0.85, 1))
    drive = make_drive([0.85, -0.85, above, -above])
    assert drive.departed(0.85).tolist() == [False, False, True, True]


def test_environments_of_your_own_come_after_ours():
    names = ("zoo", "mine", "deployment", "surrogate")
    drives = [make_drive([0.1], environment=name) for name in names]
    found = metrics.summarise(drives, LANES)["straight"]
    assert list(found) == ["surrogate", "deployment", "mine", "zoo"]
    assert list(make_document(drives)["routes"]["straight"]) == list(found)


def test_sums_by_hand():
    runs = [make_drive([0.5, 0.9, -1.0], run=1), make_drive([0.1, -0.3, 0.2], run=0)]
    figures = metrics.summarise(runs, LANES)["straight"]["surrogate"]["random"]
    assert figures["n"] == 2
    assert figures["cross_track_mean_m"] == pytest.approx(3.0 / 6)
    assert figures["cross_track_max_m"] == 1.0
    assert figures["cross_track_total"] == pytest.approx((0.6 + 2.4) / 2)
    assert figures["steps_departed"] == 2
    assert figures["drives_departed"] == 1
    assert figures["cross_track_mean_worst_run_m"] == pytest.approx(0.8)
    first, second = figures["per_run"]
    assert (first["run"], first["seed"], second["run"]) == (0, 100, 1)
    assert first["cross_track_mean_m"] == pytest.approx(0.2)
    assert second["cross_track_total"] == pytest.approx(2.4)
    assert (first["steps_departed"], second["steps_departed"]) == (0, 2)


def test_time_out_of_the_lane_and_of_return():
    left = [0.9, 2.0, -1.8, 0.8, 0.9, 0.2]  # out, out with the centre, in, out, in
    runs = [
        make_drive(left, run=0),
        make_drive([0.9] * 4, run=1),
        make_drive([0.85], run=2),
    ]
    figures = metrics.summarise(runs, LANES)["straight"]["surrogate"]["random"]
    rows = figures["per_run"]
    assert [row["wheel_out_s"] for row in rows] == pytest.approx([0.4, 0.4, 0])
    assert [row["centre_out_s"] for row in rows] == pytest.approx([0.2, 0, 0])
    assert [row["returned_s"] for row in rows] == [pytest.approx(0.6), None, None]
    assert figures["wheel_out_s"] == pytest.approx(0.8 / 3)
    assert figures["centre_out_s"] == pytest.approx(0.2 / 3)


def test_seconds_are_those_of_the_steps():
    drive = make_drive([0.0, 1.0, 0.0], time_s=[0.1, 0.6, 0.7])
    figures = metrics.summarise([drive], LANES)["straight"]["surrogate"]["random"]
    assert figures["wheel_out_s"] == pytest.approx(0.5)


def test_a_drive_counts_once_whatever_its_length():
    runs = [make_drive([0.0] * 9, run=0), make_drive([1.0], run=1)]
    figures = metrics.summarise(runs, LANES)["straight"]["surrogate"]["random"]
    assert figures["cross_track_mean_m"] == pytest.approx(0.5)


def test_the_mean_lies_in_its_interval():
    """Long drives near the centre, and short ones that leave it."""
    runs = [make_drive([0.1] * 1000, run=run) for run in range(15)]
    runs += [make_drive([1.0] * 20, run=run) for run in range(15, 20)]
    card = metrics.card_figures(runs, 0.5)
    low, high = card["cross_track_mean_ci95_m"]
    assert low < card["cross_track_mean_m"] < high


def test_interval_of_two_runs_is_their_range():
    # A quarter of the resamples of two runs holds one of them twice: both 2.5 %
    # quantiles of the mean fall on the runs' means themselves.
    runs = [make_drive([0.1, 0.1], run=0), make_drive([0.4, 0.4], run=1)]
    figures = metrics.summarise(runs, LANES)["straight"]["surrogate"]["random"]
    assert figures["cross_track_mean_ci95_m"] == pytest.approx([0.1, 0.4])


@pytest.mark.parametrize("case", [name for name in CASES if name != "random"])
def test_starts_alone_give_no_interval(case):
    runs = [make_drive([0.1 * run], case=case, run=run) for run in range(3)]
    figures = metrics.summarise(runs, LANES)["straight"]["surrogate"][case]
    assert figures["cross_track_mean_ci95_m"] is None


def test_interval_covers_the_normal_one():
    rng = np.random.default_rng(5)
    means = rng.uniform(0.1, 0.3, 60)
    runs = [make_drive([mean], run=run) for run, mean in enumerate(means)]
    figures = metrics.summarise(runs, LANES, seed=2)["straight"]["surrogate"]["random"]
    half = 1.96 * means.std() / np.sqrt(60)
    expected = [means.mean() - half, means.mean() + half]
    assert figures["cross_track_mean_ci95_m"] == pytest.approx(expected, abs=0.1 * half)
    again = metrics.summarise(runs, LANES, seed=2)["straight"]["surrogate"]["random"]
    assert again == figures


def test_interval_of_equal_runs_is_a_point_and_of_one_run_null():
    runs = [make_drive([0.25], run=run) for run in range(4)]
    figures = metrics.summarise(runs, LANES)["straight"]["surrogate"]["random"]
    assert figures["cross_track_mean_ci95_m"] == [0.25, 0.25]
    figures = metrics.summarise(runs[:1], LANES)["straight"]["surrogate"]["random"]
    assert figures["cross_track_mean_ci95_m"] is None


def test_same_run_twice_and_missing_lane_are_refused():
    with pytest.raises(InputError, match="run 0 twice"):
        metrics.summarise([make_drive([0.1]), make_drive([0.2])], LANES)
    with pytest.raises(InputError, match="no lane for route 'left'"):
        metrics.summarise([make_drive([0.1], route="left")], LANES)


def test_document_follows_the_schema(tmp_path):
    document = make_document()
    files.write_json(tmp_path / "metrics.json", document)
    read = files.read_json(tmp_path / "metrics.json")
    metrics.validate(read)
    assert (read["schema"], read["seed"], read["scenario"]) == (2, 7, {"name": "x"})
    assert read["cost"] == COST
    assert list(read["routes"]["straight"]["surrogate"]) == ["own", "random"]
    case = read["routes"]["straight"]["deployment"]["attack"]
    assert case["n"] == 1
    assert case["steps_departed"] == 2


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("schema",), 1, "metrics.schema"),
        (("flags",), [1], "metrics.flags.0"),
        (("saturated_share",), 1.5, "metrics.saturated_share"),
        (("cost", "renders"), 1.5, "metrics.cost.renders"),
        (("cost", "wall_s"), float("nan"), "metrics.cost.wall_s"),
        (("routes",), {}, "metrics.routes"),
        (
            ("curve",),
            {"frames": [4], "objective": [], "cross_track_mean_m": [0.1]},
            "metrics.curve: Value error, columns of different lengths",
        ),
        (
            ("routes", "straight", "moon"),
            {"lost": {}},
            "metrics.routes.straight.moon.lost",
        ),
        (("routes", "straight", "surrogate", "random", "n"), 3, "n is 3"),
        (
            (
                "routes",
                "straight",
                "surrogate",
                "random",
                "per_run",
                1,
                "steps_departed",
            ),
            -1,
            "random.per_run.1.steps_departed",
        ),
    ],
)
def test_validate_names_the_key(place, value, message):
    document = json.loads(json.dumps(make_document()))
    target = document
    for key in place[:-1]:
        target = target[key]
    target[place[-1]] = value
    with pytest.raises(InputError, match=re.escape(message)):
        metrics.validate(document)


def test_validate_names_a_missing_key():
    document = make_document()
    del document["cost"]["renders"]
    with pytest.raises(InputError, match=r"metrics\.cost\.renders: Field required"):
        metrics.validate(document)
