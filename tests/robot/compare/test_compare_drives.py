"""Real drives beside those of a run that were drawn, not driven."""

from __future__ import annotations

import json
import os
import shutil
import time

import numpy as np
import pytest
from helpers.attack_jobs import write_scenario
from helpers.made_drives import COST
from helpers.recorded_drives import CALIBRATION, image_message, pose_message, write_log

from mi_nerfattack import cli
from mi_nerfattack.evaluation.metrics import metrics_document
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.kept_drives import KeptDrives
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.robot.compare.aligned import align
from mi_nerfattack.robot.compare.course import Course
from mi_nerfattack.robot.compare.recorded import read_recorded
from mi_nerfattack.robot.compare.views import draw_views
from mi_nerfattack.rollout.drive import Drive, Lane
from mi_nerfattack.vehicle.route.route import Route

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
SPEED, PERIOD, STEPS = 5.0, 0.1, 24
LENGTH = SPEED * PERIOD * STEPS
ANGLE = 2 * np.pi * np.arange(600) / 600
LOOP = Route("loop", 0, 10 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], 1), closed=True)
LINE = Route("line", 0, np.array([[-20.0, 0], [60, 0]]))


def course_of(route: Route, start: float = 0.0, length: float = LENGTH, **changes):
    camera, mount = from_fov(16, 8, 90.0), CameraMount()
    about = {"control_unit": "rad/s", "wheelbase": 2.7} | changes
    lane = Lane(0.85, 1.75)
    return Course(route, start, start + length, lane, camera, mount, PERIOD, **about)


def swerved(route: Route, arcs: np.ndarray, most: float, left=0.0) -> np.ndarray:
    """Return states (n, 3) that leave the lane to the right by `most` about 8 m."""
    lateral = left - most * np.exp(-(((arcs - 8) / 2) ** 2))
    slope = np.gradient(lateral, arcs)
    return route.pose_at(arcs, lateral, np.arctan(slope))


def made(route: Route, case: str, most: float, run: int = 0, left=0.0) -> Drive:
    """Return a drive of the run."""
    states = swerved(route, SPEED * PERIOD * np.arange(STEPS + 1), most, left)
    times = PERIOD * np.arange(1, STEPS + 1)
    controls, errors = np.diff(states[:, 2]) / PERIOD, route.cross_track_numpy(states)
    about = "surrogate", route.name, case, run, run
    return Drive(*about, states, controls, errors[1:], times)


def write_drive(path, states, period: float, began: float):
    """Write a recording of a vehicle's states (n, 3)."""
    poses = np.tile(np.eye(4), (len(states), 1, 1))
    cos, sin = np.cos(states[:, 2]), np.sin(states[:, 2])
    poses[:, 0, 0], poses[:, 0, 1] = cos, -sin
    poses[:, 1, 0], poses[:, 1, 1] = sin, cos
    poses[:, :2, 3] = states[:, :2]
    times = began + period * np.arange(len(states))
    image = image_message(path.parent, 0.0, 0)
    stamps = [pose_message(t, m) for t, m in zip(times, poses, strict=True)]
    images = [{**image, "timestamp": item["timestamp"]} for item in stamps]
    topics = {
        "/camera/image": ("foxglove.CompressedImage", images),
        "/vehicle/pose": ("foxglove.PoseInFrame", stamps),
        "/camera/calibration": ("foxglove.CameraCalibration", [CALIBRATION]),
    }
    return write_log(path, topics)


def real(path, most: float, began: float, until: float = 14.0, speed: float = 4.0):
    """Write a drive along LINE from 3 m before the stretch, at another speed."""
    period = 0.02 * 4.0
    return write_drive(
        path,
        swerved(LINE, np.arange(-3.0, until, speed * period), most),
        period,
        began,
    )


@pytest.mark.parametrize("route", [LINE, LOOP], ids=["line", "loop"])
def test_the_same_path_at_another_speed(route, tmp_path):
    """Aligned by place: no difference, and the time that the way takes longer."""
    course = course_of(route)
    # on the loop the stretch comes after most of a lap, and again a lap later
    begin = -3.0 if route is LINE else -40.0
    end = 14.0 if route is LINE else 90.0
    arcs = np.arange(begin, end, 0.3)
    states = swerved(route, arcs, 1.5)
    path = write_drive(tmp_path / "real.mcap", states, 0.3 / 4, 1.8e9)
    recorded = read_recorded(path, "attack", 0, course)
    assert recorded.is_whole and recorded.began == pytest.approx(1.8e9)
    assert recorded.drive.time_s[-1] == pytest.approx(LENGTH / 4, abs=0.15)
    run = [made(route, "attack", 1.5, left=left) for left in (-0.1, 0.1)]
    found = align(course, recorded, run, [], []).figures()
    # outside of a bend, the nearest place of the polygon is its vertex
    assert found["cross_track_rms_m"] < 0.03 and found["within_range"] > 0.95
    assert found["cross_track_correlation"] > 0.999
    assert found["control_correlation"] > 0.98
    assert found["steering_change_correlation"] is None
    covered = found["to_m"] - found["from_m"]
    assert covered == pytest.approx(LENGTH, abs=0.6)
    assert found["time_behind_s"] == pytest.approx(covered / 4 - covered / 5, abs=0.02)


def test_change_of_steering(tmp_path):
    """What the look changes agrees, though both plain drives steer differently."""
    course = course_of(LINE)
    weave = 0.02 * np.sin(2 * np.arange(-3, 14, 0.3))
    drives = []
    for number, most in enumerate((0.0, 1.5)):
        states = swerved(LINE, np.arange(-3, 14, 0.3), most)
        states[:, 2] += weave
        path = write_drive(tmp_path / f"{number}.mcap", states, 0.06, 1.8e9)
        drives.append(read_recorded(path, ("own", "attack")[number], 0, course))
    own, attacked = drives
    run = made(LINE, "own", 0.0), made(LINE, "attack", 1.5)
    args = [own.drive], [run[0]]
    found = align(course, attacked, [run[1]], *args).figures()
    assert found["steering_change_correlation"] > 0.98
    assert found["within_range"] is None
    assert align(course, own, [run[0]], [], []).figures()["control_correlation"] is None


def test_a_drive_that_never_comes_back(tmp_path):
    """It is whole once it has driven as far as the run's drives; the rest is cut."""
    course = course_of(LINE)
    turn = np.radians(70)
    way = np.arange(0, 60, 0.3)
    away = np.maximum(way - 5, 0)
    x, y = np.minimum(way, 5) - 20 + np.cos(turn) * away, np.sin(turn) * away
    states = np.stack([x, y, np.where(away > 0, turn, 0)], 1)
    path = write_drive(tmp_path / "away.mcap", states, 0.06, 1.8e9)
    recorded = read_recorded(path, "attack", 0, course)
    driven = np.hypot(*np.diff(recorded.drive.states[:, :2], axis=0).T).sum()
    assert driven == pytest.approx(LENGTH, abs=0.31) and recorded.is_whole
    reached = 5 + 7 * np.cos(turn)
    assert recorded.coverage == pytest.approx(reached / LENGTH, abs=0.03)
    early = write_drive(tmp_path / "early.mcap", states[:30], 0.06, 1.8e9)
    assert not read_recorded(early, "attack", 0, course).is_whole


def write_coloured(folder, states, arcs):
    """Write a recording whose frames are the redder the further."""
    files.make_folder(folder)
    rows = ["time_s,file,x_m,y_m,heading_rad"]
    for k, (state, arc) in enumerate(zip(states, arcs, strict=True)):
        image = np.full((8, 16, 3), [round(15 * max(arc, 0)), 255, 0], np.uint8)
        files.write_image(folder / f"{k}.png", image)
        rows.append(",".join(map(str, [0.1 * k, f"{k}.png", *state])))
    files.write_text(folder / "poses.csv", "\n".join([*rows, ""]))
    return folder


def test_views_at_equal_places(tmp_path):
    """Both rows show the same places, a control period apart at most."""
    course, drive = course_of(LINE), made(LINE, "attack", 1.5)
    driven = drive.states[:-1]
    frames = tmp_path / "frames"
    write_coloured(frames / "surrogate_attack", driven, course.arcs(driven))
    arcs = np.arange(-3.0, 14, 0.4)
    real = write_coloured(tmp_path / "real", swerved(LINE, arcs, 1.4), arcs)
    aligned = align(course, read_recorded(real, "attack", 0, course), [drive], [], [])
    picture = tmp_path / "views.png"
    draw_views(picture, [aligned], [drive], tmp_path / "elsewhere", course)
    assert not picture.exists()
    draw_views(picture, [aligned], [drive], frames, course)
    image = files.read_image(picture).astype(int)
    shown = (image[..., 1] == 255) & (image[..., 2] == 0)
    lines = np.flatnonzero(shown.any(1))
    bands = np.split(lines, np.flatnonzero(np.diff(lines) > 1) + 1)
    found = [np.unique(image[band[0], shown[band[0]], 0]) / 15 for band in bands]
    assert len(found) == 2 and len(found[0]) == len(found[1]) == 6
    places = np.linspace(aligned.places[0], aligned.places[-3], 6)
    for row, step in zip(found, (SPEED * PERIOD, 0.4), strict=True):
        assert (row - places).min() > -0.05 and (row - places).max() < step + 0.05


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


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Make the folder of a finished run without driving."""
    from mi_nerfattack.scenario.scenario import load_scenario

    folder = write_scenario(
        tmp_path_factory.mktemp("drawn"), {"horizon = 2": f"horizon = {STEPS}"}
    )
    scenario, _ = load_scenario(folder / "scenario.toml")
    shutil.copytree(folder, folder / "run")
    folder = folder / "run"
    (folder / "objects").mkdir()
    shutil.copy(folder / "object.safetensors", folder / "objects" / "ball.safetensors")
    kept = KeptDrives(folder / "drives", scenario.identity(), "line", 1)
    drives = [made(LINE, "own", 0.05, k) for k in range(2)]
    drives += [made(LINE, "attack", most, k) for k, most in enumerate((1.4, 1.6))]
    for drive in drives:
        kept.add(drive, Effort())
    document = metrics_document({}, 1, drives, {"line": Lane(0.85, 1.75)}, COST)
    files.write_json(folder / "metrics.json", document)
    return folder


@pytest.fixture
def criteria(tmp_path):
    path = tmp_path / "criteria.toml"
    path.write_text(CRITERIA)
    os.utime(path, (1.79e9, 1.79e9))
    return path


def call(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main(["compare-drives", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_a_campaign(run, criteria, tmp_path, capsys):
    """Criteria first, then drive by drive to the decision; nothing is lost on the way.

    Each success triples the ratio, which is accepted at nine.
    """
    out = tmp_path / "compared"
    code, told, err = call(capsys, run, criteria, "-o", out)
    assert code == 0, err
    assert "expected drives 3.2 at 0.75, 3.2 at 0.25" in told
    assert "0 of 0 succeeded: go on" in told and not (out / "comparison.png").exists()
    plain = real(tmp_path / "plain.mcap", 0.05, 1.8e9)
    attacked = [
        real(tmp_path / f"{k}.mcap", most, 1.8e9 + 100 * (k + 1), until)
        for k, (most, until) in enumerate(((1.5, 14), (0.2, 14), (0.2, 6), (1.7, 10)))
    ]
    both = ("--own", plain, "--attack")
    decisions = []
    for count in range(1, 5):
        arguments = (run, criteria, "-o", out, *both, *attacked[:count], "--json")
        code, told, err = call(capsys, *arguments)
        assert code == 0, err
        decisions.append(json.loads(told)["test"]["decision"])
    assert decisions == ["go on"] * 4
    document = json.loads(told)
    assert document == json.loads((out / "metrics.json").read_text())
    rows = document["drives"]
    assert [row.get("success") for row in rows] == [None, True, False, None, True]
    assert rows[0]["case"] == "own" and "decision" not in rows[0]
    assert rows[3]["coverage"] == pytest.approx(0.5, abs=0.05)
    assert rows[1]["beside_run"]["steering_change_correlation"] > 0.98
    assert rows[1]["figures"]["cross_track_max_m"] == pytest.approx(1.5, abs=0.02)
    test = document["test"]
    assert (test["drives"], test["successes"]) == (3, 2)
    assert test["log_likelihood_ratio"] == pytest.approx(np.log(3))
    last = real(tmp_path / "last.mcap", 1.5, 1.8e9 + 900)
    more = real(tmp_path / "more.mcap", 0.3, 1.8e9 + 999)
    code, told, err = call(
        capsys, run, criteria, "-o", out, *both, *attacked, last, more
    )
    assert code == 0, err
    assert "3 of 4 succeeded: accept, the rate of success is 0.75" in told
    assert "1 drives after the decision do not count" in told
    assert "2.mcap (attack)" in told and "not judged, it ends after" in told
    assert (out / "summary.txt").read_text() in told
    assert {p.name for p in out.iterdir()} == {
        "metrics.json",
        "summary.txt",
        "comparison.png",
        "overhead.png",
    }
    kept = {path: path.read_bytes() for path in out.iterdir()}
    for given, message in (
        ((*both, *attacked[:2]), "drive 2 past attack is"),
        ((*both, attacked[0], last), "now " + str(last)),
        (("--attack", *attacked, last, more), "drive 0 past own is"),
        ((*both, *attacked, last, more, last), f"is the drive of {last} again"),
        ((*both, *attacked, more, last), "give the drives of --attack in the order"),
        ((*both, *attacked, last, more, "--random", plain), "is the drive of"),
    ):
        code, told, err = call(capsys, run, criteria, "-o", out, *given)
        assert (code, told) == (2, "") and message in err, err
    criteria.write_text(CRITERIA + "# as I meant it\n")
    given = (*both, *attacked, last, more)
    code, _, err = call(capsys, run, criteria, "-o", out, *given)
    assert code == 2 and "was begun with the criteria" in err
    assert kept == {path: path.read_bytes() for path in out.iterdir()}
    # touched, but unchanged: it was there before the first drive
    criteria.write_text(CRITERIA)
    assert call(capsys, run, criteria, "-o", out, *given)[0] == 0


def test_refused(run, criteria, tmp_path, capsys):
    out = tmp_path / "compared"
    good = real(tmp_path / "good.mcap", 0.5, 1.8e9)
    early = real(tmp_path / "early.mcap", 0.5, 1.78e9)
    arcs = np.arange(-3.0, 14, 0.3)
    states = swerved(LINE, arcs, 0.5)
    drives = {
        "millimetres": states * [1000, 1000, 1] + [0, 50000, 0],
        "turned": states + [0, 0, np.radians(150)],
        "elsewhere": states + [40, 0, 0],
        "standing": np.repeat(states[20:21], 9, 0),
        "short": states[12:14],
        "gap": np.delete(states, slice(20, 27), 0),
    }
    paths = {
        name: write_drive(tmp_path / f"{name}.mcap", value, 0.075, 1.8e9)
        for name, value in drives.items()
    }
    old = tmp_path / "old"
    files.make_folder(old)
    (old / "notes.txt").write_text("mine")
    for given, message in (
        (("--attack", early), "after " + str(early) + " began"),
        (("--random", good), "no drives past random in surrogate, only past own"),
        (("--attack", good, "--environment", "car"), "there are: surrogate_attack"),
        (("--attack", paths["millimetres"]), "in another frame of the world"),
        (("--attack", paths["turned"]), "turned from it by 150 degrees"),
        (("--attack", paths["elsewhere"]), "cover 37.00 to 53"),
        (("--attack", paths["standing"]), "its 9 poses cover 3.00 to 3.00 m"),
        (("--attack", paths["short"]), "the run's drives 0.00 to 12.00 m"),
        (("--attack", paths["gap"]), "its pose moves by 2.4"),
        (("--attack", tmp_path / "none.mcap"), "does not exist"),
        (("--attack", good, "-o", old), "holds notes.txt, and no comparison"),
        (("--attack", good, "-o", run), "is not of compare-drives"),
    ):
        where = () if "-o" in given else ("-o", out)
        code, told, err = call(capsys, run, criteria, *where, *given)
        assert (code, told) == (2, "") and message in err, (given, err)
        assert not out.exists() or not list(out.iterdir())
    code, _, err = call(capsys, tmp_path, criteria, "-o", out)
    assert code == 2 and "holds no finished attack" in err


def test_recordings_without_a_clock(run, criteria, tmp_path, capsys):
    """The time of the file tells; criteria that are younger are refused."""
    recording = real(tmp_path / "drive.mcap", 1.5, 0.0)
    arguments = (run, criteria, "--attack", recording, "-o", tmp_path / "compared")
    now = time.time()
    os.utime(recording, (now, now))
    os.utime(criteria, (now - 1, now - 1))  # while it was driven
    code, _, err = call(capsys, *arguments)
    assert code == 2 and "criteria come first" in err
    os.utime(criteria, (now - 60, now - 60))
    assert call(capsys, *arguments)[0] == 0
