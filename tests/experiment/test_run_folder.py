"""Run folders that are new, foreign, damaged, or on a full disk."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys

import pytest
from helpers.attack_jobs import contents, interrupt, job, stop_at

from mi_nerfattack import cli
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.claim import claimed
from mi_nerfattack.io import locks

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize("left", ["nothing", "partial", "scenario", "drives"])
def test_run_killed_early_starts_from_the_beginning(folder, whole, tmp_path, left):
    output = tmp_path / "run"
    partial = output / ".scenario.toml.0123456789ab.tmp"
    if left != "nothing":
        output.mkdir()
    if left in ("partial", "scenario"):
        partial.write_text("half of")
    if left in ("scenario", "drives"):
        shutil.copy(whole[0] / "scenario.toml", output)
    if left == "drives":
        interrupt(folder, tmp_path / "cut", "surrogate: random", 1)
        shutil.copytree(tmp_path / "cut" / "drives", output / "drives")
    job(folder, output).run()
    assert (output / "metrics.json").exists() and not partial.exists()


def test_numbers_come_without_pictures(folder, whole, tmp_path):
    output = tmp_path / "run"
    shutil.copytree(whole[0], output)
    (output / "metrics.json").unlink()
    late = job(folder, output)
    late.frames = None
    document = late.run()
    assert document["verdict"] and document["textures"]
    found = {path.name for path in output.iterdir()} - {
        path.name for path in whole[0].iterdir()
    }
    assert found == {"attack.json", "objects", "steps.csv"}


@pytest.mark.usefixtures("no_results")
def test_folder_of_something_else_is_left_alone(folder, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else than a run"):
        job(folder, tmp_path).run()
    (tmp_path / "scenario.toml").write_text("# a scenario of my own")
    with pytest.raises(InputError, match="holds something else than a run"):
        job(folder, tmp_path).run()
    (tmp_path / "alone").mkdir()
    shutil.move(tmp_path / "scenario.toml", tmp_path / "alone")
    with pytest.raises(InputError, match=r"scenario\.toml: is another scenario"):
        job(folder, tmp_path / "alone").run()
    with pytest.raises(InputError, match="is not a folder"):
        job(folder, tmp_path / "notes.txt").run()
    assert len(list(tmp_path.iterdir())) == 2
    kept = tmp_path / "alone" / "scenario.toml"
    assert kept.read_text() == "# a scenario of my own"


@pytest.mark.usefixtures("no_results")
def test_scenario_of_which_nothing_was_done_is_replaced_by_force(folder, tmp_path):
    (tmp_path / "scenario.toml").write_text("# a scenario of a run killed early")
    notices = []
    job(folder, tmp_path, notices=notices).run(force=True)
    assert any("replaced, as told" in notice for notice in notices)
    assert 'name = "kill"' in (tmp_path / "scenario.toml").read_text()
    assert (tmp_path / "metrics.json").exists()


@pytest.mark.usefixtures("no_results")
def test_two_processes_do_not_work_in_one_folder(folder, tmp_path):
    output = tmp_path / "run"
    interrupt(folder, output, "surrogate: optimisation", 4 * 3 + 1)
    with locks.exclusive(output), pytest.raises(InputError, match="another process"):
        job(folder, output).run()
    job(folder, output).run()


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize(
    "name",
    ["checkpoint.safetensors", "drives/surrogate_own_0000.safetensors"],
)
@pytest.mark.parametrize("damage", ["cut", "bit", "foreign"])
def test_damaged_and_foreign_files_are_refused_by_name(folder, tmp_path, name, damage):
    output = tmp_path / "run"
    interrupt(folder, output, "surrogate: optimisation", 4 * 3 + 1)
    raw = bytearray((output / name).read_bytes())
    if damage == "foreign":
        raw = (folder / "object.safetensors").read_bytes()
    elif damage == "cut":
        raw = raw[:-7]
    else:
        raw[-9] ^= 1
    (output / name).write_bytes(raw)
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        job(folder, output).run()
    assert (output / name).read_bytes() == raw


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize(
    ("call", "number"), [("open", errno.EROFS), ("write", errno.ENOSPC)]
)
def test_failed_checkpoint_leaves_the_one_before(
    folder, tmp_path, monkeypatch, call, number
):
    output = tmp_path / "run"
    path = output / "checkpoint.safetensors"
    original = getattr(os, call)
    kept = {}

    def fail(*arguments, **more):
        if call == "open" and not str(arguments[0]).endswith(".tmp"):
            return original(*arguments, **more)
        raise OSError(number, os.strerror(number))

    def fill():
        kept.update(contents(output))
        monkeypatch.setattr(os, call, fail)

    # checkpoint_every = 3: the disk fills up after the first checkpoint
    progress = stop_at("surrogate: optimisation", 4 * 4, fill)
    with pytest.raises(InputError) as failed:
        job(folder, output, on_progress=progress).run()
    monkeypatch.undo()
    message = str(failed.value)
    assert str(path) in message and "the same command continues" in message
    assert ("no space left" if number == errno.ENOSPC else "read-only") in message
    assert "iteration 6 is not saved" in message
    assert "checkpoint of iteration 3 is intact" in message
    assert contents(output) == kept
    job(folder, output).run()


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize("stage", ["surrogate: own", "surrogate: optimisation"])
def test_a_refused_attack_leaves_nothing(folder, tmp_path, stage):
    def refuse():
        raise InputError("policy: control nan")

    (tmp_path / "empty").mkdir()
    for output in (tmp_path / "made" / "run", tmp_path / "empty"):
        with pytest.raises(InputError, match="control nan"):
            job(folder, output, on_progress=stop_at(stage, 2, refuse)).run()
    assert contents(tmp_path) == {} and list(tmp_path.iterdir()) == [output]


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize(("step", "cause"), [(3, OSError()), (4 * 2 + 3, None)])
def test_what_no_other_scenario_mends_is_kept(folder, tmp_path, step, cause):
    """A full disk, and iterations that are done."""

    def refuse():
        raise InputError("disk or gradient") from cause

    with pytest.raises(InputError, match="disk or gradient"):
        stop = stop_at("surrogate: optimisation", step, refuse)
        job(folder, tmp_path, on_progress=stop).run()
    seen = {path.name for path in tmp_path.iterdir()}
    assert seen >= {"scenario.toml", "drives"}


def test_a_claimed_folder_is_ours_and_empty_ones_are_removed(tmp_path):
    output = tmp_path / "made" / "run"
    with claimed(output), pytest.raises(InputError, match="another process"):
        with claimed(output):
            pass
    assert not (tmp_path / "made").exists()
    with claimed(output):
        (output / "a").write_text("")
    with pytest.raises(InputError, match="holds something else than a run"):
        with claimed(output):
            pass
    (output / "scenario.toml").write_text("")
    (output / "drives").mkdir()
    with claimed(output):
        pass
    with pytest.raises(InputError, match="is not a folder"):
        with claimed(output / "a"):
            pass
    assert {path.name for path in output.iterdir()} == {"a", "drives", "scenario.toml"}


def test_a_second_attack_is_refused_before_anything_is_loaded(tmp_path):
    code = (
        "import sys\n"
        "from mi_nerfattack.cli import main\n"
        "print(main(['attack', 'absent.toml', '-o', '.']), 'torch' in sys.modules)\n"
    )
    command = [sys.executable, "-c", code]
    with locks.exclusive(tmp_path):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "2 False\n", done.stderr
    assert "another process works in it" in done.stderr


def test_a_demo_is_refused_before_its_object_is_fitted(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert cli.main(["demo", "-o", str(tmp_path), "--object", "absent.glb"]) == 2
    assert "holds something else than a run" in capsys.readouterr().err


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
