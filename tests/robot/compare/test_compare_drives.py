"""The command that compares drives, on a run that was drawn, not driven."""

from __future__ import annotations

import json
import os
import shutil
import time

import numpy as np
import pytest
from helpers.attack_jobs import write_scenario
from helpers.made_drives import COST
from helpers.real_drives import LINE, STEPS, made, real, swerved, write_drive

from mi_nerfattack import cli
from mi_nerfattack.evaluation.metrics import metrics_document
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.kept_drives import KeptDrives
from mi_nerfattack.io import files, locks
from mi_nerfattack.rollout.drive import Lane

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
    code = cli.main(["car", "compare", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture
def recordings(tmp_path):
    """Return real drives: one past the plain object, and past the attack in order."""
    plain = real(tmp_path / "plain.mcap", 0.05, 1.8e9)
    drives = (1.5, 14), (0.2, 14), (0.2, 6), (1.7, 10), (1.5, 14), (0.3, 14)
    return plain, [
        real(tmp_path / f"{k}.mcap", most, 1.8e9 + 100 * (k + 1), until)
        for k, (most, until) in enumerate(drives)
    ]


def test_a_campaign(run, criteria, recordings, tmp_path, capsys):
    """Criteria first, then drive by drive to the decision.

    Each success triples the ratio, which is accepted at nine.
    """
    out, (plain, attacked) = tmp_path / "compared", recordings
    code, told, err = call(capsys, run, criteria, "-o", out)
    assert code == 0, err
    assert "expected drives 3.2 at 0.75, 3.2 at 0.25" in told
    assert "0 of 0 succeeded: go on" in told and not (out / "comparison.png").exists()
    arguments = (run, criteria, "-o", out, "--own", plain, "--attack")
    decisions, document = [], {}
    for count in range(1, 5):
        code, told, err = call(capsys, *arguments, *attacked[:count], "--json")
        assert code == 0, err
        document = json.loads(told)
        decisions.append(document["test"]["decision"])
    assert decisions == ["go on"] * 4
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
    code, told, err = call(capsys, *arguments, *attacked)
    assert code == 0, err
    assert "3 of 4 succeeded: accept, the rate of success is 0.75" in told
    assert "1 drives after the decision do not count" in told
    assert "2.mcap (attack)" in told and "not judged, it ends after" in told
    assert (out / "summary.txt").read_text() in told
    names = {"metrics.json", "summary.txt", "comparison.png", "overhead.png"}
    assert {path.name for path in out.iterdir()} == names


def test_a_second_process_is_refused(run, criteria, recordings, tmp_path, capsys):
    output = tmp_path / "out"
    output.mkdir()
    plain, _ = recordings
    with locks.exclusive(output):
        code, _, err = call(capsys, run, criteria, "--own", plain, "-o", output)
    assert code == 2 and "another process works in it" in err
    assert not list(output.iterdir())


def test_what_was_judged_stays(run, criteria, recordings, tmp_path, capsys):
    out, (plain, attacked) = tmp_path / "compared", recordings
    first, second, third, *_ = attacked
    before = ("--own", plain, "--attack", first, second)
    assert call(capsys, run, criteria, "-o", out, *before)[0] == 0
    kept = {path: path.read_bytes() for path in out.iterdir()}
    for given, message in (
        (before[:-1], "drive 1 past attack is"),
        ((*before[:-1], third), f"now {third}"),
        (("--attack", first, second), "drive 0 past own is"),
        ((*before, second), f"is the drive of {second} again"),
        ((*before[:-2], second, first), "give the drives of --attack in the order"),
        ((*before, "--random", plain), "is the drive of"),
        ((*before, "--environment", "mitsuba"), "was begun with the environment"),
    ):
        code, told, err = call(capsys, run, criteria, "-o", out, *given)
        assert (code, told) == (2, "") and message in err, err
    criteria.write_text(CRITERIA + "# as I meant it\n")
    code, _, err = call(capsys, run, criteria, "-o", out, *before, third)
    assert code == 2 and "was begun with the criteria" in err
    assert kept == {path: path.read_bytes() for path in out.iterdir()}
    # touched, but unchanged: it was there before the first drive
    criteria.write_text(CRITERIA)
    assert call(capsys, run, criteria, "-o", out, *before, third)[0] == 0


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
        (("--attack", good, "-o", run), "is not of car compare"),
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
