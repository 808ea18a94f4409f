"""Metrics and tables by hand, and pictures and pages that hold what they show."""

from __future__ import annotations

import base64
import csv
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import rich.console

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation import metrics
from mi_nerfattack.io import files
from mi_nerfattack.report import table
from mi_nerfattack.report.pages import attack as page
from mi_nerfattack.report.plots import drives as plots
from mi_nerfattack.rollout.drive import CASES, Drive, Lane, departure_limit

#: What `metrics.json` of a run folder holds.
RUN_ENVIRONMENTS = ("surrogate", "deployment")
LANES = {"straight": Lane(0.85, 1.75)}
COST = {"wall_s": 12.5, "peak_memory_mb": 900.0, "renders": 240}


def make_drive(
    errors, environment="surrogate", case="random", run=0, route="straight", **changes
):
    """Return a drive along +x in steps of half a metre with the given errors."""
    errors = np.asarray(errors, dtype=float)
    steps = len(errors)
    states = np.zeros((steps + 1, 3))
    states[:, 0] = 0.5 * np.arange(steps + 1)
    states[1:, 1] = errors
    fields = {
        "states": states,
        "controls": np.linspace(-0.1, 0.1, steps),
        "cross_track_m": errors,
        "time_s": 0.1 * np.arange(1, steps + 1),
    }
    return Drive(environment, route, case, run, 100 + run, **{**fields, **changes})


def make_document(drives=None):
    drives = drives or [
        make_drive([0.1, -0.3], case="own"),
        make_drive([0.1, -0.3, 0.2], run=0),
        make_drive([0.5, 0.9, 1.0], run=1),
        make_drive([1.0, 1.2], case="attack", environment="deployment"),
    ]
    return metrics.metrics_document({"name": "x"}, 7, drives, LANES, COST)


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


def test_mean_is_over_steps_when_runs_differ_in_length():
    runs = [make_drive([0.0] * 9, run=0), make_drive([1.0], run=1)]
    figures = metrics.summarise(runs, LANES)["straight"]["surrogate"]["random"]
    assert figures["cross_track_mean_m"] == pytest.approx(0.1)


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


# Tables


def test_steps_hold_a_row_per_step(tmp_path):
    drives = [make_drive([0.1, -0.9]), make_drive([1 / 3], case="attack")]
    table.write_steps(tmp_path / "steps.csv", drives, LANES)
    rows = list(csv.DictReader(io.StringIO(files.read_text(tmp_path / "steps.csv"))))
    assert tuple(rows[0]) == table.STEP_COLUMNS
    assert [row["step"] for row in rows] == ["1", "2", "1"]
    assert [row["departed"] for row in rows] == ["0", "1", "0"]
    assert float(rows[1]["x_m"]) == 1.0
    assert float(rows[1]["control"]) == 0.1
    assert float(rows[2]["cross_track_m"]) == 1 / 3
    assert rows[2]["case"] == "attack"


def test_metrics_table_fits_80_columns():
    drives = [
        make_drive([123.4, 0.1], environment, case, run, route="roundabout")
        for environment in RUN_ENVIRONMENTS
        for case in CASES
        for run in range(100)
    ]
    figures = metrics.summarise(drives, {"roundabout": Lane(0.85, 1.75)})
    console = rich.console.Console(width=80, file=io.StringIO(), color_system=None)
    console.print(table.metrics_table({"routes": figures}))
    text = console.file.getvalue()
    assert all(len(line) <= 80 for line in text.splitlines())
    assert text.count("own") == 2
    assert "61.750" in text
    assert "…" not in text


# Pictures


def plot_drives():
    drives = []
    for environment in RUN_ENVIRONMENTS:
        drives.append(make_drive(np.full(40, 0.02), environment, "own"))
        for run in range(3):
            drives.append(
                make_drive(np.full(30 + run, 0.1 * run), environment, run=run)
            )
        drives.append(make_drive(np.linspace(0, 1.5, 40), environment, "attack"))
    return drives


def count(image, colour, tolerance=12):
    distance = np.abs(image[..., :3].astype(int) - np.array(colour)).max(axis=-1)
    return int((distance <= tolerance).sum())


BLUE, RED, YELLOW = (0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00), (0xF0, 0xC0, 0x00)
SQUARE = np.array([[9, -3], [10, -3], [10, -2], [9, -2]])
ROUTE = np.array([[0.0, 0.0], [10.0, 0.0], [30.0, 0.0]])


def test_overhead_shows_drives_and_object(tmp_path):
    path = tmp_path / "overhead.png"
    plots.overhead(path, plot_drives(), ROUTE, 3.5, [SQUARE], 0.85)
    image = files.read_image(path)
    assert image.shape[1] == plots.WIDTH_PX
    assert count(image, BLUE) > 1500
    assert count(image, RED) > 1500
    assert count(image, YELLOW) > 500
    # The blue lines are 20 m long, 2.2 points wide and level: equal axes make the
    # square of one metre as wide as it is high, and the scales agree.
    upper = image[: image.shape[0] // 2]
    rows, columns = np.nonzero(
        np.abs(upper[..., :3].astype(int) - YELLOW).max(axis=-1) <= 12
    )
    assert abs(np.ptp(rows) - np.ptp(columns)) <= 2
    rows, columns = np.nonzero(
        np.abs(upper[..., :3].astype(int) - BLUE).max(axis=-1) <= 12
    )
    side = np.ptp(columns) / 20
    assert np.ptp(rows) < 8
    assert 20 < side < 60


def test_overhead_has_a_panel_for_an_environment_of_your_own(tmp_path):
    drives = [make_drive([0.1, 0.2], name, "own") for name in ("a", "b")]
    plots.overhead(tmp_path / "one.png", drives[:1], ROUTE, 3.5, [], 0.85)
    plots.overhead(tmp_path / "two.png", drives, ROUTE, 3.5, [], 0.85)
    one, two = (files.read_image(tmp_path / f"{name}.png") for name in ("one", "two"))
    assert count(two, BLUE) > 0 < count(one, BLUE)
    assert one.shape != two.shape


def test_errors_and_convergence(tmp_path):
    plots.errors(tmp_path / "errors.png", plot_drives(), 0.85)
    image = files.read_image(tmp_path / "errors.png")
    assert image.shape[1] == plots.WIDTH_PX
    assert min(count(image, BLUE), count(image, RED)) > 500
    history = [{"objective": i, "cross_track_mean_m": 0.1 * i} for i in range(5)]
    plots.convergence(tmp_path / "convergence.png", history)
    image = files.read_image(tmp_path / "convergence.png")
    assert image.shape[1] == plots.WIDTH_PX
    assert count(image, RED) > 1000


# Page


class Reader(HTMLParser):
    """Collect text and image sources, and check that tags nest."""

    def __init__(self):
        super().__init__()
        self.open, self.text, self.sources, self.links = [], [], [], []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag == "img":
            self.sources.append(values["src"])
        self.links += [v for k, v in attrs if k in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_page_is_self_contained_and_escaped(tmp_path):
    pixels = np.random.default_rng(4).integers(0, 256, (5, 6, 3), dtype=np.uint8)
    files.write_image(tmp_path / "a.png", pixels)
    drives = [
        make_drive([0.125], route="<b>x</b>"),
        make_drive([1.0], route="<b>x</b>", run=1),
    ]
    document = metrics.metrics_document(
        {"name": "<i>"}, 7, drives, {"<b>x</b>": Lane(0.85, 1.75)}, COST
    )
    title, scenario = 'Plot "1" <script>alert(1)</script>', "a = '</pre>$seed & <i>'"
    path = tmp_path / "report.html"
    page.write_report(
        path, document, {title: tmp_path / "a.png"}, scenario, {"mitsuba": "3.9<1"}
    )
    reader = Reader()
    reader.feed(files.read_text(path))
    reader.close()
    text = "".join(reader.text)
    assert reader.open == []
    assert scenario in text
    assert title in text
    assert "3.9<1" in text
    assert "0.562" in text
    assert "<title>&lt;i&gt;</title>" in files.read_text(path)
    assert "<script" not in files.read_text(path)
    assert all(link.startswith("data:") for link in reader.links)
    (source,) = reader.sources
    (tmp_path / "b.png").write_bytes(base64.b64decode(source.partition(",")[2]))
    np.testing.assert_array_equal(files.read_image(tmp_path / "b.png"), pixels)


def test_page_names_a_missing_picture(tmp_path):
    images = {"a": tmp_path / "none.png"}
    with pytest.raises(InputError, match=r"none\.png"):
        page.write_report(tmp_path / "r.html", make_document(), images, "", {})
    assert not (tmp_path / "r.html").exists()
