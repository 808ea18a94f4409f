"""Real drives cut to a run's stretch, and the command that summarises both."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.devices.car import RADIUS, Bench
from support.devices.car import SPEED as DRIVEN_MS
from support.files.recordings import CALIBRATION, image_message, pose_message, write_log
from support.files.runs import COST
from support.worlds.attacks import write_scenario

from mi_nerfattack import cli
from mi_nerfattack.deploy.car import Car
from mi_nerfattack.drives.spec import FORMAT, DriveSpec
from mi_nerfattack.drives.store import Store
from mi_nerfattack.drives.table import STEPS as COLUMNS
from mi_nerfattack.drives.table import read_csv
from mi_nerfattack.evaluation.metrics import metrics_document
from mi_nerfattack.experiment.real import Course, read_real
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.rollout.drive import Drive, Lane
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

SPEED, PERIOD, STEPS = 5.0, 0.1, 24
LENGTH = SPEED * PERIOD * STEPS
ANGLE = 2 * np.pi * np.arange(600) / 600
LOOP = Route("loop", 0, 10 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], 1), closed=True)
LINE = Route("line", 0, np.array([[-20.0, 0], [60, 0]]))


def course_of(route: Route, start: float = 0.0, length: float = LENGTH, **changes):
    camera, mount = from_fov(16, 8, 90.0), CameraMount()
    car, lane = Car(max_control=0.7, **changes), Lane(0.85, 1.75)
    return Course(route, start, start + length, lane, camera, mount, PERIOD, car)


def beside(route: Route, arcs: np.ndarray, lateral: np.ndarray) -> np.ndarray:
    """Return states (n, 3) at a distance to the left of a route."""
    return route.pose_at(arcs, lateral, np.arctan(np.gradient(lateral, arcs)))


def swerved(route: Route, arcs: np.ndarray, most: float) -> np.ndarray:
    """Return states (n, 3) that leave the lane to the right by `most` about 8 m."""
    return beside(route, arcs, -most * np.exp(-(((arcs - 8) / 2) ** 2)))


def made(route: Route, case: str, most: float, run: int = 0) -> Drive:
    """Return a drive of the run."""
    states = swerved(route, SPEED * PERIOD * np.arange(STEPS + 1), most)
    times = PERIOD * np.arange(1, STEPS + 1)
    controls, errors = np.diff(states[:, 2]) / PERIOD, route.cross_track_numpy(states)
    labels = "surrogate", route.name, case, run, run
    return Drive(*labels, states, controls, errors[1:], times)


def write_drive(path, states, period: float, began: float = 1.8e9):
    """Write a recording of a vehicle's states (n, 3)."""
    poses = np.tile(np.eye(4), (len(states), 1, 1))
    poses[:, :2, :2] = Rotation.from_euler("z", states[:, 2:]).as_matrix()[:, :2, :2]
    poses[:, :2, 3] = states[:, :2]
    times = began + period * np.arange(len(states))
    image = image_message(path.parent, 0.0, 0)
    stamps = [pose_message(t, m) for t, m in zip(times, poses, strict=True)]
    images = [{**image, "header": item["header"]} for item in stamps]
    topics = {
        "/camera/image": ("sensor_msgs/CompressedImage", images),
        "/vehicle/pose": ("geometry_msgs/PoseStamped", stamps),
        "/camera/camera_info": ("sensor_msgs/CameraInfo", [CALIBRATION]),
    }
    return write_log(path, topics)


def recorded(folder, course: Course, states: np.ndarray, period: float):
    return read_real(
        write_drive(folder / "a.mcap", states, period), "attack", 0, course
    )


@pytest.mark.parametrize(
    ("route", "begin", "end"),
    [(LINE, -3.0, 14.0), (LOOP, -40.0, 90.0)],
    ids=["line", "loop"],
)
def test_a_drive_is_cut_to_the_stretch(route, begin, end, tmp_path):
    """At another speed; on the loop, the stretch comes after most of a lap."""
    course, states = course_of(route), swerved(route, np.arange(begin, end, 0.3), 1.5)
    cut = recorded(tmp_path, course, states, 0.3 / 4)
    assert cut.is_whole and cut.drive.environment == "real"
    assert cut.drive.time_s[-1] == pytest.approx(LENGTH / 4, abs=0.15)
    of_run, places = made(route, "attack", 1.5), np.linspace(1.0, 11.0, 30)
    errors = [
        np.interp(places, course.arcs(drive.states[1:]), drive.cross_track_m)
        for drive in (cut.drive, of_run)
    ]
    # outside of a bend, the nearest place of the polygon is its vertex
    assert np.abs(np.subtract(*errors)).max() < 0.06


def test_tracked_poses_are_of_the_rear_axle(tmp_path):
    """The model's point is 1.35 m ahead: as far to the left as the heading says."""
    arcs = np.arange(-3.0, 14.0, 0.3)
    axle = LINE.pose_at(arcs, 0.0, np.full_like(arcs, 0.2))
    course = course_of(LINE, reference=1.35, control_unit="rad")
    cut = recorded(tmp_path, course, axle, 0.06)
    np.testing.assert_allclose(cut.drive.cross_track_m, 1.35 * np.sin(0.2), atol=1e-6)
    turn, radius = 0.01 * np.arange(20), 9.0
    circle = np.stack([radius * np.sin(turn), radius * (1 - np.cos(turn)), turn], 1)
    ahead = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    steered = course.controls(circle + 1.35 * ahead, 0.1 * np.arange(20))
    np.testing.assert_allclose(steered, np.arctan(2.7 / radius), rtol=1e-3)


def test_a_drive_that_never_comes_back(tmp_path):
    """It is whole once it has driven as far as the run's drives; the rest is cut."""
    course, turn = course_of(LINE), np.radians(70)
    way = np.arange(0, 60, 0.3)
    away = np.maximum(way - 5, 0)
    x, y = np.minimum(way, 5) - 20 + np.cos(turn) * away, np.sin(turn) * away
    states = np.stack([x, y, np.where(away > 0, turn, 0)], 1)
    cut = recorded(tmp_path, course, states, 0.06)
    driven = np.hypot(*np.diff(cut.drive.states[:, :2], axis=0).T).sum()
    assert driven == pytest.approx(LENGTH, abs=0.31) and cut.is_whole
    reached = 5 + 7 * np.cos(turn)
    assert cut.coverage == pytest.approx(reached / LENGTH, abs=0.03)
    assert not recorded(tmp_path, course, states[:30], 0.06).is_whole


def test_weaving_in_the_lane_is_no_way_along_it(tmp_path):
    """It stops early, though its path is as long as the stretch."""
    arcs = np.arange(0, 0.85 * LENGTH, 0.1)
    states = beside(LINE, arcs, 0.8 * np.sin(2 * arcs))
    cut = recorded(tmp_path, course_of(LINE), states, 0.02)
    assert cut.driven > 1 and cut.coverage == pytest.approx(0.85, abs=0.02)
    assert not cut.is_whole


def test_the_log_of_a_drive(tmp_path):
    """A stand-in of a car, driven by the loop in a circle, drives on its centre."""
    path, bench = tmp_path / "drive.mcap", Bench()
    bench.at(0.5, lambda: setattr(bench, "held", True))
    bench.drive(path, duration_s=6.0)
    circle = RADIUS * np.stack([np.sin(ANGLE), -np.cos(ANGLE)], 1)
    route = Route("circle", 0, circle, 0.6, DRIVEN_MS, closed=True)
    course = course_of(route, 1.5 * DRIVEN_MS, 3 * DRIVEN_MS)
    recorded = read_real(path, "own", 0, course)
    assert recorded.is_whole and not recorded.remarks
    assert recorded.drive.distance_m.max() < 0.01
    assert recorded.drive.time_s[-1] == pytest.approx(3, abs=0.15)
    rates = recorded.drive.controls
    assert rates.mean() == pytest.approx(DRIVEN_MS / RADIUS, rel=0.02)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-2000])
    assert "cut off" in read_real(cut, "own", 0, course).remarks[0]


def test_steering_angles_as_driven():
    """On a circle of 10 m the single-track model steers by atan(l / 10)."""
    course = course_of(LOOP, control_unit="rad", wheelbase=0.5)
    angle = np.linspace(0, 1, 200)
    x, y = 10 * np.cos(angle), 10 * np.sin(angle)
    states = np.stack([x, y, angle + np.pi / 2], 1)
    controls = course.controls(states, np.arange(200.0))
    np.testing.assert_allclose(controls, np.arctan(0.05), rtol=1e-4)
    # backwards through the cut of the angle, a heading rate
    course = course_of(LOOP)
    states = np.array([[0, 0, np.pi - 0.1], [0.1, 0, -np.pi + 0.1]])
    assert course.controls(states, np.array([0, 0.5])) == pytest.approx([0.4])


CRITERIA = """\
case = "attack"
metric = "wheel_out_s"
at_least = 0.3
[test]
p0 = 0.25
p1 = 0.75
alpha = 0.1
beta = 0.1
"""


def add(store: Store, drive: Drive) -> None:
    labels = drive.environment, drive.route, drive.case, drive.run, drive.seed
    spec = DriveSpec(*labels, STEPS, {"format": FORMAT, "case": drive.case})
    store.add(spec, drive, 1.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Make the folder of a finished run without driving."""
    mi.set_variant("llvm_ad_rgb")
    horizon = {"horizon = 2": f"horizon = {STEPS}"}
    folder = write_scenario(tmp_path_factory.mktemp("drawn") / "run", horizon)
    (folder / "objects").mkdir()
    shutil.copy(folder / "object.safetensors", folder / "objects" / "ball.safetensors")
    store = Store(folder / "drives")
    drives = [made(LINE, "own", 0.05, k) for k in range(2)]
    drives += [made(LINE, "attack", most, k) for k, most in enumerate((1.4, 1.6))]
    for drive in drives:
        add(store, drive)
    document = metrics_document({}, 1, drives, {"line": Lane(0.85, 1.75)}, COST)
    files.write_json(folder / "metrics.json", document)
    return folder


def real(path, most: float, number: int = 0, until: float = 14.0):
    """Write a drive along LINE from 3 m before the stretch, at 4 m/s."""
    states = swerved(LINE, np.arange(-3.0, until, 0.32), most)
    return write_drive(path, states, 0.08, 1.8e9 + 100 * number)


def call(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main(["car", "compare", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_real_drives_are_an_environment_of_the_run(run, tmp_path, capsys):
    """Each success triples the ratio, which is accepted at nine."""
    (tmp_path / "criteria.toml").write_text(CRITERIA)
    plain = real(tmp_path / "plain.mcap", 0.05)
    drives = (1.5, 14), (0.2, 14), (0.2, 6), (1.7, 10), (1.5, 14), (0.3, 14)
    attacked = [
        real(tmp_path / f"{k}.mcap", most, k, until)
        for k, (most, until) in enumerate(drives)
    ]
    out = tmp_path / "compared"
    arguments = (run, "-o", out, "--criteria", tmp_path / "criteria.toml")
    code, text, _ = call(capsys, *arguments)
    assert code == 0 and "3.2 at 0.75, 3.2 at 0.25" in text  # drives that it will take
    assert not (out / "overhead.png").exists()
    arguments = (*arguments, "--own", plain, "--attack")

    def judged(count: int):
        code, text, err = call(capsys, *arguments, *attacked[:count], "--json")
        assert code == 0, err
        assert json.loads(text) == json.loads((out / "metrics.json").read_text())
        return json.loads(text)

    assert judged(1)["test"]["decision"] == "go on"
    document = judged(4)
    rows = document["real"]
    assert [row.get("success") for row in rows] == [None, True, False, None, True]
    assert rows[0]["case"] == "own" and "decision" not in rows[0]
    assert rows[3]["coverage"] == pytest.approx(0.5, abs=0.05)
    environments = document["routes"]["line"]
    assert list(environments) == ["surrogate", "real"]
    figures = environments["real"]["attack"]
    assert figures["n"] == 4 and environments["surrogate"]["attack"]["n"] == 2
    largest = [each["cross_track_max_m"] for each in figures["per_run"]]
    np.testing.assert_allclose(largest, [1.5, 0.2, 0.2 * np.exp(-1), 1.7], atol=0.02)
    test = document["test"]
    assert (test["drives"], test["successes"], test["decision"]) == (3, 2, "go on")
    assert test["log_likelihood_ratio"] == pytest.approx(np.log(3))
    test = judged(6)["test"]  # the last comes after the decision, and does not count
    assert (test["drives"], test["successes"], test["decision"]) == (4, 3, "accept")
    assert {path.name for path in out.iterdir()} == {
        "metrics.json",
        "steps.csv",
        "overhead.png",
    }


def test_drives_of_an_open_loop_are_left_out(run, tmp_path, capsys):
    """A replay keeps its drives, and its environment has no row of metrics."""
    folder, out = shutil.copytree(run, tmp_path / "run"), tmp_path / "compared"
    drive = replace(made(LINE, "own", 0.05), environment="replay")
    add(Store(folder / "drives"), drive)
    code, _, err = call(capsys, folder, "-o", out)
    assert code == 0, err
    routes = files.read_json(out / "metrics.json")["routes"]
    assert list(routes["line"]) == ["surrogate"]
    steps = read_csv(out / "steps.csv", COLUMNS)
    assert set(steps["environment"]) == {"surrogate"}


def test_recordings_that_are_refused(run, tmp_path, capsys):
    out = tmp_path / "compared"
    good = real(tmp_path / "good.mcap", 0.5)
    states = swerved(LINE, np.arange(-3.0, 14, 0.3), 0.5)
    drives = {  # and a number that the message gives
        "millimetres": (states * [1000, 1000, 1] + [0, 50000, 0], "(-14600, 49764, 1)"),
        "turned": (states + [0, 0, np.radians(150)], "150 degrees"),
        "elsewhere": (states + [40, 0, 0], "37.00 to 53"),
        "standing": (np.repeat(states[20:21], 9, 0), "3.00 to 3.00 m"),
        "short": (states[12:14], "0.00 to 12.00 m"),
        "gap": (np.delete(states, slice(20, 27), 0), "2.4"),
    }
    for name, (value, number) in drives.items():
        path = write_drive(tmp_path / f"{name}.mcap", value, 0.075)
        code, _, err = call(capsys, run, "-o", out, "--attack", path)
        assert code == 2 and f"error: {path}: " in err and number in err
    for words, where in (
        ((run, "-o", out, "--attack", tmp_path / "none.mcap"), tmp_path / "none.mcap"),
        ((run, "-o", out, "--attack", good, "--own", good), good),
        ((run, "-o", run, "--attack", good), f"-o: {run}"),
        ((tmp_path, "-o", out), tmp_path),
    ):
        code, _, err = call(capsys, *words)
        assert code == 2 and f"error: {where}" in err, err
    assert not out.exists()
