"""Plots and the table of steps hold what they show."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
from support.faults.refusals import refused_at
from support.files.runs import LANES, RUN_ENVIRONMENTS, make_drive
from support.pages.read import drawn
from support.worlds.places import write_place

from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.drives.table import FURTHER, STEPS, read_csv, write_steps
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation import metrics
from mi_nerfattack.fields.io import load_field
from mi_nerfattack.io import files
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.report.plots import strip
from mi_nerfattack.report.plots.charts import VARIABLE
from mi_nerfattack.report.plots.curves import convergence
from mi_nerfattack.report.plots.drives import by_name, errors
from mi_nerfattack.report.plots.map import overhead
from mi_nerfattack.report.plots.place import Overlay, car_outline, routes_picture
from mi_nerfattack.report.table import metrics_table
from mi_nerfattack.rollout.drive import CASES, Drive
from mi_nerfattack.vehicle.route.route import Route, load_routes

ROUTE = Route("straight", 0, np.array([[0.0, 0.0], [10.0, 0.0], [30.0, 0.0]]))
SQUARE = np.array([[9, -3], [10, -3], [10, -2], [9, -2]])


def holds(axis, data) -> bool:
    """Whether a line of an axis goes through points (n, 2) and no others."""
    polylines = [np.asarray(line.get_xydata()) for line in axis.lines]
    return any(f.shape == data.shape and np.allclose(f, data) for f in polylines)


def test_iterations_and_the_best_so_far_are_drawn(monkeypatch):
    history = [{"objective": -i, "cross_track_mean_m": 0.1 * i} for i in range(5)]
    means = [0.0, 0.1, 0.2, 0.3, 0.4, 0.4]
    curve = {"frames": [10, 35, 60, 85, 110, 135], "cross_track_mean_m": means}
    curve["objective"] = [0.0, -1.0, -2.0, -3.0, -4.0, -4.0]
    figures = drawn(monkeypatch)
    for optional_curve in (None, curve):
        convergence("convergence.png", history, optional_curve)
    by_iteration, by_frames = figures
    for index, name in enumerate(("objective", "cross_track_mean_m")):
        values, first = [x[name] for x in history], by_iteration.axes[index]
        assert holds(first, np.stack([range(5), values], 1)) and len(first.lines) == 1
        second = by_frames.axes[index]
        assert holds(second, np.stack([curve["frames"][:5], values], 1))
        assert holds(second, np.stack([curve["frames"], curve[name]], 1))


def test_predicted_and_real_gains_are_drawn(monkeypatch):
    rows = [{"objective": -i, "cross_track_mean_m": 0.1 * i} for i in range(3)]
    gains = [[5.0, 1.0], [4.0, -0.5], [3.0, 0.1]]
    keys = "predicted_gain", "gain"
    history = [
        r | dict(zip(keys, g, strict=True)) for r, g in zip(rows, gains, strict=True)
    ]
    figures = drawn(monkeypatch)
    convergence("convergence.png", history)
    (figure,) = figures
    *_, last = figure.axes
    for column in np.array(gains).T:
        assert holds(last, np.stack([range(3), column], 1))


def test_maps_and_errors_show_drives_and_objects(monkeypatch):
    """Both environments have a panel, with equal axes."""
    drives = [
        make_drive(np.linspace(0, 1.5, 40), environment, case)
        for environment in RUN_ENVIRONMENTS
        for case in ("own", "attack")
    ]
    looks = [make_drive(np.full(30 + k, 0.1 * k), run=k) for k in range(3)]
    figures = drawn(monkeypatch)
    overhead("overhead.png", drives, ROUTE, [SQUARE], 0.85)
    errors("errors.png", by_name([*drives, *looks]), {"straight": 0.85})
    for figure in figures:
        assert len(figure.axes) == 2
    for axis in figures[0].axes:
        assert axis.get_aspect() == 1
        assert holds(axis, drives[0].states[:, :2])
        out = drives[0].states[1:][drives[0].departed(0.85), :2]
        assert 0 < len(out) < 40 and holds(axis, out)
        corners = [patch.get_xy()[:4] for patch in axis.patches]
        assert any(np.array_equal(corner_set, SQUARE) for corner_set in corners)
    for axis in figures[1].axes:
        times, distances = drives[0].time_s, np.abs(drives[0].cross_track_m)
        assert holds(axis, np.stack([times, distances], 1))
    # of random looks the mean, over those that last so long
    mean = [0.1] * 30 + [0.15, 0.2]
    assert holds(figures[1].axes[0], np.stack([looks[2].time_s, mean], 1))


@pytest.mark.usefixtures("variant")
def test_a_place_from_above_as_capture_and_train_write_it(tmp_path):
    place = write_place(tmp_path)
    assert place.field is not None
    sensor = field_sensor(PosedField(load_field(place.field)), [], place.camera)
    routes, path = load_routes(place.routes), tmp_path / "place.png"
    routes_picture(path, place.scene, routes, place.camera, place.mount, sensor, "a")
    assert files.read_image(path).shape[1] == 1600
    extent = Overlay(routes).overhead(100).extent
    assert extent[:2] == pytest.approx((-5.25, 45.25))


def test_a_car_stands_about_its_rear_axle():
    corners = car_outline(np.array([2.0, 1.0, np.pi / 2]), 1.8)
    ends = [corners.min(0), corners.max(0)]
    np.testing.assert_allclose(ends, [[1.1, 0.1], [2.9, 4.42]])
    # seen from a point 1.35 m ahead of the rear axle, the car is as far back
    ahead = car_outline(np.array([2.0, 2.35, np.pi / 2]), 1.8, 1.35)
    np.testing.assert_allclose(ahead, corners)


def test_strip_doubles_frames_exactly(tmp_path, rng):
    frames = [rng.integers(0, 256, (66, 200, 3), dtype=np.uint8) for _ in range(2)]
    path = tmp_path / "strip.png"
    strip.first_person_strip(
        path, {"a": frames, "longer\nlabel": frames[:1]}, ["0 m", "7.5 m"]
    )
    image = files.read_image(path)
    doubled = np.kron(frames[1], np.ones((2, 2, 1), dtype=np.uint8))
    left = image.shape[1] - strip.GAP_PX - 400
    top = strip.FONT_PX + 2 * strip.GAP_PX
    np.testing.assert_array_equal(image[top : top + 132, left : left + 400], doubled)
    assert (image[top + 138 : top + 270, left : left + 400] == 225).all()


def drive_at(states):
    """Return a drive through states (n + 1, 3), a second a period."""
    times = np.arange(1.0, len(states))
    return Drive("surrogate", "line", "own", 0, 0, states, 0 * times, 0 * times, times)


def test_rows_show_the_same_places():
    """One drives at half the speed, from 2 m farther on, and one ends early."""
    line = Route("line", 0, np.array([[0.0, 0.0], [60.0, 0.0]]))
    drives = [
        drive_at(line.pose_at(x)) for x in (np.arange(42.0), 2 + 0.5 * np.arange(78))
    ]
    drives.append(drive_at(line.pose_at(np.arange(22.0))))
    places, steps = strip.aligned_steps(line, drives, 5)
    np.testing.assert_allclose(places, [0, 10, 20, 30, 40])
    assert steps == [[0, 10, 20, 30, 40], [0, 16, 36, 56, 76], [0, 10, 20]]
    # laps are places of their own
    corners = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    square = Route("square", 0, corners, closed=True)
    lap = drive_at(square.pose_at(np.arange(62.0)))
    places, (steps,) = strip.aligned_steps(square, [lap], 4)
    np.testing.assert_allclose(places, [0, 20, 40, 60])
    assert steps == [0, 20, 40, 60]
    # a start just before the first point of the route is near it, not a lap further
    drives = [drive_at(square.pose_at(x + np.arange(22.0))) for x in (-0.02, 0.02)]
    places, steps = strip.aligned_steps(square, drives, 3)
    np.testing.assert_allclose(places, [-0.02, 9.99, 20.0], atol=0.03)
    assert steps == [[0, 10, 20]] * 2


def test_tiles_stand_row_by_row_under_their_titles():
    colours = {"one": 10, "two": 90, "three": 170}
    images = {n: np.full((5, 100, 3), v, np.uint8) for n, v in colours.items()}
    sheet = strip.tiles(images)
    scale = strip.TILE_PX // 100
    assert scale == 4 and sheet.shape[1] == 2 * (400 + strip.GAP_PX) + strip.GAP_PX
    values = [int(v) for v in sheet[:, strip.GAP_PX + 399, 0] if v in colours.values()]
    assert values == [10] * 20 + [170] * 20
    right = sheet[:, 2 * strip.GAP_PX + 400 :, 0]
    assert (right == 90).sum() >= 20 * 400
    large = strip.tiles({"one": np.zeros((5, 900, 3), np.uint8)}, 1)
    assert large.shape[1] == 900 + 2 * strip.GAP_PX


def test_steps_hold_a_row_per_step(tmp_path):
    drives = [make_drive([0.1, -0.9]), make_drive([1 / 3], case="attack")]
    write_steps(tmp_path / "steps.csv", drives, LANES)
    rows = list(csv.DictReader(io.StringIO(files.read_text(tmp_path / "steps.csv"))))
    where = ["x_m", "y_m", "heading_rad", "control", "cross_track_m", "departed"]
    names = ["environment", "route", "case", "run", "seed", "step", "time_s"]
    assert list(rows[0]) == names + where
    assert [row["step"] for row in rows] == ["1", "2", "1"]
    assert [row["departed"] for row in rows] == ["0", "1", "0"]
    assert float(rows[1]["x_m"]) == 1.0
    assert float(rows[1]["control"]) == 0.1
    assert float(rows[2]["cross_track_m"]) == 1 / 3
    assert rows[2]["case"] == "attack"


def test_steps_hold_all_rows_of_the_state(tmp_path):
    states = np.arange(10.0).reshape(2, 5)
    drives = [make_drive([0.1, -0.9]), make_drive([0.2], case="own", states=states)]
    write_steps(tmp_path / "steps.csv", drives, LANES)
    table = read_csv(tmp_path / "steps.csv", STEPS, FURTHER)
    assert list(table.columns[len(STEPS) :]) == ["state_3", "state_4"]
    extra_states = table[["state_3", "state_4"]].to_numpy()
    np.testing.assert_array_equal(extra_states, [[np.nan] * 2, [np.nan] * 2, [8, 9]])
    with refused_at(str(tmp_path / "steps.csv")):
        read_csv(tmp_path / "steps.csv", STEPS)


def test_a_table_has_a_record_for_each_case():
    names = [(where, case) for where in RUN_ENVIRONMENTS for case in CASES]
    drives = [make_drive([0.1], where, case) for where, case in names]
    figures = metrics.summarise(drives, LANES)
    records = metrics_table({"routes": figures}).records
    pairs = [(row["environment"], row["case"]) for row in records]
    assert sorted(pairs) == sorted(names)


def test_charts_are_vectors_too_where_the_variable_asks(tmp_path, monkeypatch):
    history = [{"objective": -i, "cross_track_mean_m": 0.1 * i} for i in range(5)]
    convergence(tmp_path / "a.png", history, None)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    monkeypatch.setenv(VARIABLE, "pdf, svg")
    for name in ("a.png", "b.png"):
        convergence(tmp_path / name, history, None)
    names = [f"{stem}.{kind}" for stem in "ab" for kind in ("pdf", "png", "svg")]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for kind, start in (("pdf", b"%PDF"), ("svg", b"<?xml")):
        one, other = ((tmp_path / f"{stem}.{kind}").read_bytes() for stem in "ab")
        assert one == other and one.startswith(start)
    monkeypatch.setenv(VARIABLE, "eps")
    with pytest.raises(InputError, match=f"{VARIABLE}: 'eps'"):
        convergence(tmp_path / "c.png", history, None)
