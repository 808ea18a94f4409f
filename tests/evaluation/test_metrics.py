"""Figures of drives by hand, and the document that holds them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.faults.refusals import refused_at
from support.files.runs import COST, LANES, make_document, make_drive

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation import metrics
from mi_nerfattack.rollout.drive import CASES, departure_limit


def figures_of(*drives, seed=0):
    """Return the figures of drives of one case in the surrogate."""
    [case] = {drive.case for drive in drives}
    return metrics.summarise(drives, LANES, seed)["straight"]["surrogate"][case]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("environment", ""),
        ("case", "bayes"),
        ("route", ""),
        ("run", -1),
        ("states", np.zeros((2, 3))),
        ("time_s", np.array([0.2, 0.1])),
        ("time_s", np.array([0.1, 0.1])),
        ("controls", np.array([0.0, np.nan])),
        ("controls", np.zeros(0)),
    ],
)
def test_drive_refuses_bad_records(name, value):
    with refused_at(f"Drive.{name}"):
        make_drive([0.1, 0.2], **{name: value})


def test_drive_keeps_read_only_copies():
    errors = np.array([0.1, 0.2])
    drive = make_drive([0.1, 0.2], cross_track_m=errors)
    errors[0] = 5
    assert drive.cross_track_m[0] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        drive.states[0, 0] = 1


def test_departure_begins_beyond_the_limit():
    assert departure_limit(3.5, 1.8) == pytest.approx(0.85, abs=1e-15)
    for lane, car in ((1.8, 1.8), (3.5, 0.0), (np.nan, 1.0), (np.inf, 1.0)):
        with pytest.raises(InputError, match="car_width_m"):
            departure_limit(lane, car)
    above = float(np.nextafter(0.85, 1))
    drive = make_drive([0.85, -0.85, above, -above])
    assert drive.departed(0.85).tolist() == [False, False, True, True]


def test_environments_of_your_own_come_after_ours():
    names = ("zoo", "mine", "mitsuba", "surrogate")
    drives = [make_drive([0.1], environment=name) for name in names]
    figures = metrics.summarise(drives, LANES)["straight"]
    assert list(figures) == ["surrogate", "mitsuba", "mine", "zoo"]


def test_sums_by_hand():
    runs = [make_drive([0.5, 0.9, -1.0], run=1), make_drive([0.1, -0.3, 0.2], run=0)]
    figures = figures_of(*runs)
    assert figures["n"] == 2
    assert figures["cross_track_mean_m"] == pytest.approx(3.0 / 6)
    assert figures["cross_track_max_m"] == 1.0
    assert figures["cross_track_total"] == pytest.approx((0.6 + 2.4) / 2)
    assert (figures["steps_departed"], figures["drives_departed"]) == (2, 1)
    assert figures["cross_track_mean_worst_run_m"] == pytest.approx(0.8)
    first, second = figures["per_run"]
    assert (first["run"], first["seed"], second["run"]) == (0, 100, 1)
    assert first["cross_track_mean_m"] == pytest.approx(0.2)
    assert second["cross_track_total"] == pytest.approx(2.4)
    assert (first["steps_departed"], second["steps_departed"]) == (0, 2)
    # a drive counts once, whatever its length
    figures = figures_of(make_drive([0.0] * 9, run=0), make_drive([1.0], run=1))
    assert figures["cross_track_mean_m"] == pytest.approx(0.5)


def test_time_out_of_the_lane_and_of_return():
    left = [0.9, 2.0, -1.8, 0.8, 0.9, 0.2]  # out, out with the centre, in, out, in
    figures = figures_of(
        make_drive(left, run=0),
        make_drive([0.9] * 4, run=1),
        make_drive([0.85], run=2),
    )
    rows = figures["per_run"]
    assert [row["wheel_out_s"] for row in rows] == pytest.approx([0.4, 0.4, 0])
    assert [row["centre_out_s"] for row in rows] == pytest.approx([0.2, 0, 0])
    assert [row["returned_s"] for row in rows] == [pytest.approx(0.6), None, None]
    assert figures["wheel_out_s"] == pytest.approx(0.8 / 3)
    assert figures["centre_out_s"] == pytest.approx(0.2 / 3)
    uneven = make_drive([0.0, 1.0, 0.0], time_s=[0.1, 0.6, 0.7])
    figures = figures_of(uneven)
    assert figures["wheel_out_s"] == pytest.approx(0.5)
    assert figures["drives_departed"] == 1  # by one step


def test_the_mean_lies_in_its_interval():
    """Long drives near the centre, and short ones that leave it."""
    runs = [make_drive([0.1] * 1000, run=run) for run in range(15)]
    runs += [make_drive([1.0] * 20, run=run) for run in range(15, 20)]
    card = metrics.card_figures(runs, 0.5)
    low, high = card["cross_track_mean_ci95_m"]
    assert low < card["cross_track_mean_m"] < high


def test_intervals_of_few_and_of_equal_runs():
    four = [make_drive([mean], run=run) for run, mean in enumerate((0.1, 0.4, 0.5, 2))]
    assert figures_of(*four)["cross_track_mean_ci95_m"] is None
    equal = [make_drive([0.25], run=run) for run in range(5)]
    assert figures_of(*equal)["cross_track_mean_ci95_m"] == [0.25, 0.25]
    for case in set(CASES) - {"random"}:  # starts alone say nothing of the policy
        runs = [make_drive([0.1 * run], case=case, run=run) for run in range(6)]
        assert figures_of(*runs)["cross_track_mean_ci95_m"] is None


def test_a_card_of_few_drives_has_no_intervals():
    runs = [make_drive([0.1 * run], run=run) for run in range(1, 6)]
    few, enough = metrics.card_figures(runs[:4], 0.5), metrics.card_figures(runs, 0.5)
    for name in ("cross_track_mean_ci95_m", "departure_rate_ci95"):
        assert few[name] is None and enough[name] is not None


def test_objectives_are_averaged_and_one_that_is_missing_is_no_number():
    drives = [make_drive([0.1], run=run) for run in range(3)]
    costs = dict(zip(drives, (-3.0, -1.0, -5.0), strict=True))

    def random_figures():
        [figures] = metrics.summarise(drives, LANES, costs=costs)["straight"].values()
        return figures["random"]

    assert random_figures()["objective"] == -3
    assert [run["objective"] for run in random_figures()["per_run"]] == [-3, -1, -5]
    costs[drives[1]] = None
    assert random_figures()["objective"] is None
    assert [run["objective"] for run in random_figures()["per_run"]] == [-3, None, -5]
    costs |= dict.fromkeys(drives)
    assert random_figures()["objective"] is None


def test_interval_covers_the_normal_one():
    means = np.random.default_rng(5).uniform(0.1, 0.3, 60)
    runs = [make_drive([mean], run=run) for run, mean in enumerate(means)]
    figures = figures_of(*runs, seed=2)
    half = 1.96 * means.std() / np.sqrt(60)
    expected = [means.mean() - half, means.mean() + half]
    assert figures["cross_track_mean_ci95_m"] == pytest.approx(expected, abs=0.1 * half)
    assert figures_of(*runs, seed=2) == figures


def test_same_run_twice_and_missing_lane_are_refused():
    with pytest.raises(InputError, match="run 0 twice"):
        metrics.summarise([make_drive([0.1]), make_drive([0.2])], LANES)
    with pytest.raises(InputError, match="no lane for route 'left'"):
        metrics.summarise([make_drive([0.1], route="left")], LANES)


def test_document_follows_the_schema():
    document = json.loads(json.dumps(make_document()))
    metrics.validate(document)
    two = {"frames": [4, 8], "objective": [0.1, -2.0]}
    metrics.validate(document | {"curve": two | {"cross_track_mean_m": [0.1, 0.2]}})
    named = document["schema"], document["seed"], document["scenario"]
    assert named == (2, 7, {"name": "x"}) and document["cost"] == COST
    assert list(document["routes"]["straight"]["surrogate"]) == ["own", "random"]
    case = document["routes"]["straight"]["mitsuba"]["attack"]
    assert (case["n"], case["steps_departed"]) == (1, 2)


RANDOM = "routes straight surrogate random"


@pytest.mark.parametrize(
    ("place", "value", "where"),
    [
        ("schema", 1, "schema"),
        ("flags", [1], "flags.0"),
        ("saturated_share", 1.5, "saturated_share"),
        ("cost renders", 1.5, "cost.renders"),
        ("cost wall_s", float("nan"), "cost.wall_s"),
        ("cost renders", None, "cost.renders"),
        ("routes", {}, "routes"),
        (
            "curve",
            {"frames": [4], "objective": [], "cross_track_mean_m": [0.1]},
            "curve",
        ),
        ("routes straight moon", {"lost": {}}, "routes.straight.moon.lost"),
        (f"{RANDOM} n", 3, "routes.straight.surrogate.random"),
        (
            f"{RANDOM} per_run",
            [{"steps_departed": -1}] * 2,
            "routes.straight.surrogate.random.per_run.0",
        ),
    ],
)
def test_validate_names_the_key(place, value, where):
    document = json.loads(json.dumps(make_document()))
    target, [*keys, last] = document, place.split()
    for key in keys:
        target = target[key]
    target[last] = value
    with pytest.raises(InputError) as refused:
        metrics.validate(document)
    assert refused.value.where.startswith(f"metrics.{where}")
