"""Run folders: foreign, damaged, on a full disk; and the cases that they hold."""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.faults.injected import have_no_space
from support.faults.refusals import refused_at
from support.worlds.attacks import contents, job, stop_at

from mi_nerfattack import cli
from mi_nerfattack.commands.asset import AssetMesh
from mi_nerfattack.commands.demo import Demo
from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment import results
from mi_nerfattack.experiment.claim import claimed
from mi_nerfattack.io import files, locks
from mi_nerfattack.rollout.drive import CASES

pytestmark = [pytest.mark.usefixtures("variant", "no_results")]

OPTIMISATION = "surrogate: optimisation"


def test_a_claimed_folder_is_ours_and_empty_ones_are_removed(tmp_path, capsys):
    output = tmp_path / "made" / "run"
    with claimed(output), pytest.raises(InputError, match="another process"):
        with claimed(output):
            pass
    assert not (tmp_path / "made").exists()
    with claimed(output):
        (output / "a").write_text("")
    for path in (output, output / "a"):  # something else than a run, and a file
        with refused_at(path), claimed(path):
            pass
    assert cli.main(["demo", "absent.glb", "-o", str(output)]) == 2
    assert str(output) in capsys.readouterr().err  # before its object is fitted
    (output / "scenario.toml").write_text("")
    (output / "drives").mkdir()
    with claimed(output):
        pass
    assert {path.name for path in output.iterdir()} == {"a", "drives", "scenario.toml"}


def test_a_scenario_of_which_nothing_was_done_is_replaced_by_force(folder, tmp_path):
    path, notices = tmp_path / "scenario.toml", []
    path.write_text("# a scenario of a run killed early")
    with refused_at(path):
        job(folder, tmp_path).run()
    assert path.read_text() == "# a scenario of a run killed early"
    job(folder, tmp_path, notices=notices).run(force=True)
    assert any(str(path) in notice for notice in notices)
    assert 'name = "kill"' in path.read_text()
    assert (tmp_path / "metrics.json").exists()


@pytest.mark.parametrize(
    ("change", "anyway"),
    [
        (("[7.0, 4.2, 1.6]", "[7.0, 4.2, 4.6]"), False),  # refused by the checks
        (('"object.safetensors"', '"scene.safetensors"'), True),  # by the checkpoint
    ],
)
def test_a_refused_force_leaves_a_finished_run_to_its_scenario(
    folder, uninterrupted, tmp_path, change, anyway
):
    output = shutil.copytree(uninterrupted[0], tmp_path / "run")
    before = contents(output)
    with pytest.raises(InputError):
        job(folder, output, change).run(force=True, anyway=anyway)
    after = contents(output)
    assert {path: after.get(path) for path in before} == before
    assert job(folder, output).run()["cost"]["processes"] == 2


def test_failed_checkpoint_leaves_the_one_before(folder, tmp_path, monkeypatch):
    """The disk fills up after the first checkpoint, of iteration 3."""
    before = {}

    def fill():
        before.update(contents(tmp_path))
        monkeypatch.setattr(os, "write", lambda *_: have_no_space())

    progress = stop_at(OPTIMISATION, 4 * 4, fill)
    with pytest.raises(InputError) as failed:
        job(folder, tmp_path, on_progress=progress).run()
    assert failed.value.where == str(tmp_path / "checkpoint.safetensors")
    for iteration in ("iteration 6", "iteration 3"):  # what is lost, and what is not
        assert iteration in str(failed.value)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("stage", ["surrogate: own", OPTIMISATION])
def test_a_refused_attack_leaves_nothing(folder, tmp_path, stage):
    def refuse():
        raise InputError("policy: control nan")

    (tmp_path / "empty").mkdir()
    for output in (tmp_path / "made" / "run", tmp_path / "empty"):
        with pytest.raises(InputError, match="control nan"):
            job(folder, output, on_progress=stop_at(stage, 2, refuse)).run()
    assert contents(tmp_path) == {} and list(tmp_path.iterdir()) == [output]


@pytest.mark.parametrize(("step", "cause"), [(3, OSError()), (4 * 2 + 3, None)])
def test_what_no_other_scenario_mends_is_kept(folder, tmp_path, step, cause):
    """A full disk, and iterations that are done."""

    def refuse():
        raise InputError("disk or gradient") from cause

    with pytest.raises(InputError, match="disk or gradient"):
        stop = stop_at(OPTIMISATION, step, refuse)
        job(folder, tmp_path, on_progress=stop).run()
    names = {path.name for path in tmp_path.iterdir()}
    assert names >= {"scenario.toml", "drives"}


def test_partial_files_of_writers_are_removed_and_no_others(tmp_path):
    (tmp_path / "objects").mkdir()
    mine = [tmp_path / ".hidden.tmp", tmp_path / "a.0123456789ab.tmp"]
    stale = [
        tmp_path / ".checkpoint.safetensors.0123456789ab.tmp",
        tmp_path / "objects" / ".ball.safetensors.ba9876543210.tmp",
    ]
    for path in (*mine, *stale):
        path.write_text("")
    assert sorted(locks.remove_partial(tmp_path)) == sorted(stale)
    assert all(path.exists() for path in mine)


POSES = """\
freedom.kind = "pose"
freedom.pose_limit_m = 0.5
freedom.pose_learning_rate = 0.1"""


def test_all_cases_drive_from_the_same_starts(uninterrupted):
    drives = uninterrupted[1]["drives"]
    starts = {}
    for drive in drives:
        starts.setdefault(drive.run, []).append(drive.states[0])
    assert {drive.case for drive in drives} == set(CASES)
    for poses in starts.values():
        assert len(poses) == 10  # five cases in two environments
        assert np.ptp(poses, axis=0).max() == 0
    assert not np.array_equal(starts[0][0], starts[1][0])


def test_best_random_is_the_look_of_least_objective(uninterrupted):
    folder, document = uninterrupted
    drives = {(d.environment, d.case, d.run): d for d in document["drives"]}
    looks = [files.read_safetensors(p) for p in sorted((folder / "looks").iterdir())]
    pattern = r'"objective":\s*(-?[\d.e+-]+)'
    objectives = [
        float(re.search(pattern, meta["kept.record"])[1]) for _, meta in looks
    ]
    assert len(objectives) == 2 and objectives[0] != objectives[1]
    best = int(np.argmin(objectives))
    # of two looks and two starts: look k drives from start k
    for label in ("surrogate", "mitsuba"):
        one, other = (drives[label, case, best] for case in ("random", "best_random"))
        assert np.array_equal(one.states, other.states)


@pytest.mark.usefixtures("no_results")
def test_random_poses_are_compared_with_attacks_on_poses(folder, tmp_path, monkeypatch):
    looks = {}

    def only_looks(output, done, *arguments):
        looks.update(done.looks)
        return {}

    monkeypatch.setattr(results, "write_results", only_looks)
    job(folder, tmp_path / "run", ("iterations = 6", f"iterations = 1\n{POSES}")).run()
    assert list(looks) == ["no_object", "own", "attack", "random", "best_random"]
    assert looks["no_object"] is None
    for case in ("random", "best_random", "attack"):
        look = looks[case]
        assert np.array_equal(look.textures[0], looks["own"].textures[0])
        shift = np.abs(look.offsets[0])
        assert shift[:2].max() <= 0.5 and not shift[2:5].any()
        assert case == "attack" or shift[:2].min() > 0


@pytest.mark.usefixtures("no_results")
def test_drives_past_a_lost_attack_count_where_it_finds_the_same(
    folder, uninterrupted, tmp_path
):
    output, stages = tmp_path / "run", set()
    shutil.copytree(uninterrupted[0], output)
    (output / "checkpoint.safetensors").unlink()
    job(folder, output, on_progress=lambda *state: stages.add(state[0])).run()
    assert stages == {"surrogate: optimisation"}


@pytest.mark.usefixtures("no_results")
def test_seconds_are_those_since_the_command_began(folder, tmp_path, capsys):
    change = ("iterations = 6", "iterations = 1")
    begun = job(folder, tmp_path / "run", change)
    begun.started -= 1000
    assert begun.run()["cost"]["wall_s"] > 1000
    with StageBars(begun.started) as bars:
        bars.show("attack", 1, 1, "")
    assert int(capsys.readouterr().err.split()[0]) >= 1000


def test_a_demo_that_goes_on_keeps_its_object(tmp_path, monkeypatch):
    fits = []

    def fit(asset):
        fits.append((asset.height_m, asset.resolution))
        asset.output.write_bytes(b"field")
        return Result({}, lambda: None)

    monkeypatch.setattr(AssetMesh, "run", fit)
    mesh = tmp_path / "mesh.obj"
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    mesh.write_text(f"mtllib colours.mtl\nusemtl one\n{text}")
    colours = tmp_path / "colours.mtl"
    colours.write_text("newmtl one\nKd 1 0 0\n")
    demo = Demo(mesh, output=tmp_path / "run")
    path = tmp_path / "run-object.safetensors"
    for _ in range(2):
        assert demo._object_field(demo.output) == path
    assert fits == [(0.75, 64)]
    colours.write_text("newmtl one\nKd 0 1 0\n")  # another file of the mesh
    demo._object_field(demo.output)
    path.write_bytes(b"of another fit")
    demo._object_field(demo.output)
    assert fits == [(0.75, 64)] * 3
    replace(demo, height_m=1.5)._object_field(demo.output)
    path.unlink()
    replace(demo, height_m=1.5)._object_field(demo.output)
    assert fits == [(0.75, 64)] * 3 + [(1.5, 64)] * 2
