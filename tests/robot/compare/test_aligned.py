"""Real drives cut to a run's stretch and put beside it, place by place."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.driving_stand_ins import RADIUS, WALL_NS, Bench
from helpers.driving_stand_ins import SPEED as DRIVEN_MS
from helpers.real_drives import (
    ANGLE,
    LENGTH,
    LINE,
    LOOP,
    PERIOD,
    SPEED,
    course_of,
    made,
    swerved,
    write_drive,
)

from mi_nerfattack.io import files
from mi_nerfattack.robot.compare.aligned import align
from mi_nerfattack.robot.compare.recorded import read_recorded
from mi_nerfattack.robot.compare.views import draw_views
from mi_nerfattack.vehicle.route.route import Route


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


def test_weaving_in_the_lane_is_no_way_along_it(tmp_path):
    """It stops early, though its path is as long as the stretch."""
    course = course_of(LINE)
    arcs = np.arange(0, 0.85 * LENGTH, 0.1)
    lateral = 0.8 * np.sin(2 * arcs)
    states = LINE.pose_at(arcs, lateral, np.arctan(np.gradient(lateral, arcs)))
    path = write_drive(tmp_path / "weave.mcap", states, 0.02, 1.8e9)
    recorded = read_recorded(path, "attack", 0, course)
    assert recorded.driven > 1 and recorded.coverage == pytest.approx(0.85, abs=0.02)
    assert not recorded.is_whole


def test_the_log_of_a_drive(tmp_path):
    """A stand-in of a car, driven by the loop in a circle, drives on its centre."""
    path, bench = tmp_path / "drive.mcap", Bench()
    bench.at(0.5, lambda: setattr(bench, "held", True))
    bench.drive(path, duration_s=6.0)
    circle = RADIUS * np.stack([np.sin(ANGLE), -np.cos(ANGLE)], 1)
    route = Route("circle", 0, circle, 0.6, DRIVEN_MS, closed=True)
    course = course_of(route, 1.5 * DRIVEN_MS, 3 * DRIVEN_MS)
    recorded = read_recorded(path, "own", 0, course)
    assert recorded.is_whole and recorded.has_clock and not recorded.remarks
    assert recorded.began == pytest.approx(1e-9 * WALL_NS, abs=1)
    assert recorded.drive.distance_m.max() < 0.01
    assert recorded.drive.time_s[-1] == pytest.approx(3, abs=0.15)
    rates = recorded.drive.controls
    assert rates.mean() == pytest.approx(DRIVEN_MS / RADIUS, rel=0.02)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-2000])
    assert "cut off" in read_recorded(cut, "own", 0, course).remarks[0]


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
