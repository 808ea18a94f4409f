"""Attacks that are interrupted, killed, changed or out of disk, and go on."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
import subprocess

import numpy as np
import pytest
import torch
import toy_loop as toy

from mi_nerfattack import determinism, files, folders, resumable
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.interrupts import held_interrupts

pytestmark = pytest.mark.usefixtures("variant")

CHANGES = {
    "horizon = 2": "horizon = 2",
    "iterations = 30": "iterations = 6",
    "textures = 4": "textures = 2",
    "[drive]": f"[camera]\nwidth = {toy.WIDTH}\nheight = {toy.HEIGHT}\n[drive]",
}
STAGES = ("unperturbed", "random", "gradient")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario of tiny fields."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from mi_nerfattack.bench.kill_scenario import SCENARIO, make_scenario

    path = tmp_path_factory.mktemp("scenario")
    make_scenario(path)
    text = SCENARIO
    for old, new in CHANGES.items():
        assert old in text
        text = text.replace(old, new)
    (path / "scenario.toml").write_text(text)
    return path


@pytest.fixture
def no_results(monkeypatch):
    """Leave out plots and pages, which take seconds."""
    from mi_nerfattack.attack import results

    def only_numbers(
        output, world, drives, attack, textures, text, cost, ignored, *more
    ):
        document = {"cost": cost, "ignored_changes": ignored, "drives": drives}
        files.write_json(output / "metrics.json", {"cost": cost})
        return document

    monkeypatch.setattr(results, "write_results", only_numbers)


def job(folder, output, change=("", ""), on_progress=None, notices=None):
    from mi_nerfattack.attack.job import Job
    from mi_nerfattack.policy.adapter import TorchPolicy
    from mi_nerfattack.scenario import load_scenario

    text = (folder / "scenario.toml").read_text()
    assert change[0] in text
    path = folder / "changed.toml"
    path.write_text(text.replace(*change))
    scenario, text = load_scenario(path)
    result = Job(scenario, text, folder, TorchPolicy(toy.SmoothPolicy()), output)
    result.on_progress = on_progress or result.on_progress
    result.on_notice = (notices if notices is not None else []).append
    return result


def stop_at(stage, step, stop=None):
    """Return a progress callback that interrupts at a step of a stage."""

    def on_progress(name, done, total, remark):
        if (name, done) == (stage, step):
            if stop is not None:
                stop()
            else:
                raise KeyboardInterrupt

    return on_progress


def interrupt(folder, output, stage, step, resume=False, **more):
    with pytest.raises(KeyboardInterrupt):
        job(folder, output, on_progress=stop_at(stage, step), **more).run(resume)


def checkpoint_of(output):
    tensors, _ = files.read_safetensors(output / "checkpoint.safetensors")
    return tensors


def assert_same_state(output, whole):
    expected, found = checkpoint_of(whole), checkpoint_of(output)
    assert set(expected) == set(found)
    for name, value in expected.items():
        assert np.array_equal(value, found[name], equal_nan=True), name


def assert_same_drives(drives, expected):
    for one, other in zip(drives, expected, strict=True):
        assert (one.environment, one.case) == (other.environment, other.case)
        assert one.run == other.run
        assert np.array_equal(one.states, other.states)
        assert np.array_equal(one.controls, other.controls)


FIFTY = ("iterations = 6", "iterations = 50")


@pytest.mark.usefixtures("no_results")
def test_interrupted_deterministic_run_ends_bit_for_bit_as_the_whole(folder, tmp_path):
    whole, output = tmp_path / "whole", tmp_path / "run"
    expected = job(folder, whole, FIFTY).run()
    # 4 steps an iteration: in the drive, and in the derivative
    for resume, step in ((False, 4 * 17 + 1), (True, 4 * 32 + 3)):
        interrupt(folder, output, "surrogate: attack", step, resume, change=FIFTY)
        iteration = len(checkpoint_of(output)["history"])
        assert iteration == step // 4
    result = job(folder, output, FIFTY).run(resume=True)
    assert len(checkpoint_of(output)["history"]) == 50
    assert_same_state(output, whole)
    assert_same_drives(result["drives"], expected["drives"])
    assert result["cost"]["processes"] == 3
    assert 0 < result["cost"]["checkpoint_s"] < result["cost"]["wall_s"]


@pytest.mark.usefixtures("no_results")
def test_what_is_finished_is_not_repeated(folder, tmp_path):
    output, seen = tmp_path / "run", []
    interrupt(folder, output, "surrogate: random", 3)  # in the second of two drives
    interrupt(folder, output, "deployment: gradient", 1, resume=True)
    before = checkpoint_of(output)

    def watch(stage, done, total, remark):
        seen.append((stage, done, remark))

    document = job(folder, output, on_progress=watch).run(resume=True)
    driven = [line for line in seen if line[2] != "kept"]
    assert driven == [("deployment: gradient", k, "") for k in (1, 2)]
    kept = {stage for stage, _, remark in seen if remark == "kept"}
    assert kept == {
        f"{place}: {stage}"
        for place in ("surrogate", "deployment")
        for stage in STAGES
        if (place, stage) != ("deployment", "gradient")
    }
    for name, value in checkpoint_of(output).items():
        assert np.array_equal(value, before[name], equal_nan=True), name
    # 2 + 2 random + attack + 2, twice; the drives that were cut short count too
    assert document["cost"]["renders"] >= 2 * (2 + 2 + 2) * 2 + 6 * 2 * 2
    whole = job(folder, tmp_path / "whole").run()
    assert_same_drives(document["drives"], whole["drives"])


@pytest.mark.usefixtures("no_results")
def test_finished_run_is_resumed_without_a_drive(folder, tmp_path):
    output, seen = tmp_path / "run", []
    job(folder, output).run()

    def watch(stage, done, total, remark):
        seen.append(remark)

    job(folder, output, on_progress=watch).run(resume=True)
    assert set(seen) == {"kept"}


@pytest.mark.usefixtures("no_results")
def test_changed_scenario_is_refused_with_a_diff_unless_forced(folder, tmp_path):
    output, notices = tmp_path / "run", []
    interrupt(folder, output, "surrogate: attack", 4 * 4 + 1)
    before = {path: path.read_bytes() for path in output.iterdir()}
    change = ("learning_rate = 0.5", "learning_rate = 0.25\njitter = true")
    with pytest.raises(InputError) as refused:
        job(folder, output, change).run(resume=True)
    message = str(refused.value)
    assert str(output / "checkpoint.safetensors") in message
    assert "scenario.attack.learning_rate: 0.5 -> 0.25" in message
    assert "scenario.attack.jitter: false -> true" in message
    assert "--force" in message and "seed" not in message
    assert {path: path.read_bytes() for path in output.iterdir()} == before
    # forced, the attack goes on where it was, and the result says what was ignored
    first = []

    def watch(stage, done, total, remark):
        if stage == "surrogate: attack":
            first.append(done)

    run = job(folder, output, change, watch, notices)
    document = run.run(resume=True, force=True)
    assert first[0] == 4 * 4 + 1 and len(checkpoint_of(output)["history"]) == 6
    line = "scenario.attack.learning_rate: 0.5 -> 0.25"
    assert line in document["ignored_changes"]
    assert any(line in notice for notice in notices)
    assert "learning_rate = 0.25" in (output / "scenario.toml").read_text()
    # from then on the run is that of the changed scenario
    job(folder, output, change).run(resume=True)
    with pytest.raises(InputError, match=r"learning_rate: 0\.25 -> 0\.5"):
        job(folder, output).run(resume=True)


@pytest.mark.usefixtures("no_results")
def test_changed_file_and_version_are_named(folder, tmp_path, monkeypatch):
    from mi_nerfattack.attack import job as module

    output, mine = tmp_path / "run", tmp_path / "mine"
    shutil.copytree(folder, mine)
    interrupt(mine, output, "surrogate: attack", 4 * 3 + 1)
    # a field of another name and place but the same content is the same
    shutil.copy(mine / "object.safetensors", mine / "copy.safetensors")
    same = ('"object.safetensors"', '"copy.safetensors"')
    interrupt(mine, output, "surrogate: attack", 4 * 4 + 1, True, change=same)
    tensors, metadata = files.read_safetensors(mine / "object.safetensors")
    tensors["texture"] = tensors["texture"] + 1
    files.write_safetensors(mine / "object.safetensors", tensors, metadata)
    with pytest.raises(InputError) as refused:
        job(mine, output).run(resume=True)
    assert "objects[0].field: copy.safetensors -> object.safetensors" in str(
        refused.value
    )
    files.write_safetensors(mine / "copy.safetensors", tensors, metadata)
    with pytest.raises(InputError, match=r"content of copy\.safetensors has changed"):
        job(mine, output, same).run(resume=True)
    found = module.versions()
    changed = {**found, "drjit": "0.1"}
    monkeypatch.setattr(module, "versions", lambda: changed)
    with pytest.raises(InputError, match=f"drjit: {found['drjit']} -> 0.1"):
        job(folder, output).run(resume=True)


@pytest.mark.usefixtures("no_results")
def test_object_of_another_size_does_not_fit_by_force(folder, tmp_path):
    output = tmp_path / "run"
    interrupt(folder, output, "surrogate: attack", 4 * 3 + 1)
    other = ('"object.safetensors"', '"scene.safetensors"')
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: .*shape"):
        job(folder, output, other).run(resume=True, force=True)


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize("left", ["nothing", "folder", "partial", "scenario", "drives"])
def test_run_killed_early_starts_from_the_beginning(folder, tmp_path, left):
    output, notices = tmp_path / "run", []
    partial = output / ".scenario.toml.0123456789ab.tmp"
    if left != "nothing":
        output.mkdir()
    if left in ("partial", "scenario"):
        partial.write_text("half of")
    if left in ("scenario", "drives"):
        whole = tmp_path / "whole"
        job(folder, whole).run()
        text = (whole / "scenario.toml").read_text()
        (output / "scenario.toml").write_text(text)
    if left == "drives":
        interrupt(folder, tmp_path / "cut", "surrogate: unperturbed", 1)
        shutil.copy(tmp_path / "cut" / "drives.safetensors", output)
    job(folder, output, notices=notices).run(resume=True)
    assert (output / "metrics.json").exists() and not partial.exists()
    begins = any("starts from the beginning" in notice for notice in notices)
    assert begins == (left in ("nothing", "folder", "partial"))


@pytest.mark.usefixtures("no_results")
def test_folder_of_something_else_is_left_alone(folder, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="is no run folder"):
        job(folder, tmp_path).run(resume=True)
    (tmp_path / "scenario.toml").write_text("# a scenario of my own")
    with pytest.raises(InputError, match=r"scenario\.toml: is another scenario"):
        job(folder, tmp_path).run(resume=True)
    with pytest.raises(InputError, match="is not a folder"):
        job(folder, tmp_path / "notes.txt").run(resume=True)
    assert len(list(tmp_path.iterdir())) == 2
    assert (tmp_path / "scenario.toml").read_text() == "# a scenario of my own"


@pytest.mark.usefixtures("no_results")
def test_two_processes_do_not_work_in_one_folder(folder, tmp_path):
    output = tmp_path / "run"
    interrupt(folder, output, "surrogate: attack", 4 * 3 + 1)
    with folders.exclusive(output), pytest.raises(InputError, match="another process"):
        job(folder, output).run(resume=True)
    job(folder, output).run(resume=True)


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize("name", ["checkpoint.safetensors", "drives.safetensors"])
@pytest.mark.parametrize("damage", ["cut", "bit", "foreign"])
def test_damaged_and_foreign_files_are_refused_by_name(folder, tmp_path, name, damage):
    output = tmp_path / "run"
    interrupt(folder, output, "surrogate: attack", 4 * 3 + 1)
    raw = bytearray((output / name).read_bytes())
    if damage == "foreign":
        raw = (folder / "object.safetensors").read_bytes()
    elif damage == "cut":
        raw = raw[:-7]
    else:
        raw[-9] ^= 1
    (output / name).write_bytes(raw)
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        job(folder, output).run(resume=True)
    assert (output / name).read_bytes() == raw


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize(
    ("call", "number"),
    [
        ("open", errno.EROFS),
        ("write", errno.ENOSPC),
        ("fsync", errno.ENOSPC),
        ("replace", errno.EROFS),
    ],
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
        kept.update({path: path.read_bytes() for path in output.iterdir()})
        monkeypatch.setattr(os, call, fail)

    # checkpoint_every = 3: the disk fills up after the first checkpoint
    progress = stop_at("surrogate: attack", 4 * 4, fill)
    with pytest.raises(InputError) as failed:
        job(folder, output, on_progress=progress).run()
    monkeypatch.undo()
    message = str(failed.value)
    assert str(path) in message and "--resume" in message
    assert ("no space left" if number == errno.ENOSPC else "read-only") in message
    assert "iteration 6 is not saved" in message
    assert "checkpoint of iteration 3 is intact" in message
    assert {path: path.read_bytes() for path in output.iterdir()} == kept
    job(folder, output).run(resume=True)


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize("kind", ["full", "read-only"])
def test_checkpoint_on_a_real_disk_that_is_full_or_read_only(folder, tmp_path, kind):
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "none", str(disk)]
    if shutil.which("mount") is None or subprocess.run(command).returncode:
        pytest.skip("this user may not mount a small disk")
    try:
        _fail_on(disk, folder, kind)
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def _fail_on(disk, folder, kind):
    output = disk / "run"
    path = output / "checkpoint.safetensors"

    def spoil():
        if kind == "full":
            room = os.statvfs(disk)
            (disk / "other").write_bytes(bytes(room.f_bavail * room.f_bsize))
        else:
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)

    progress = stop_at("surrogate: attack", 4 * 4, spoil)
    with pytest.raises(InputError) as failed:
        job(folder, output, on_progress=progress).run()
    assert str(path) in str(failed.value)
    assert ("no space left" if kind == "full" else "read-only") in str(failed.value)
    assert len(checkpoint_of(output)["history"]) == 3
    if kind == "full":
        (disk / "other").unlink()
    else:
        subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
    job(folder, output).run(resume=True)
    assert len(checkpoint_of(output)["history"]) == 6


@pytest.mark.usefixtures("no_results")
def test_interrupt_within_a_step_leaves_a_whole_state(folder, tmp_path):
    whole, output = tmp_path / "whole", tmp_path / "run"
    job(folder, whole).run()

    def press():
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        progress = stop_at("surrogate: attack", 4 * 4 + 4, press)
        job(folder, output, on_progress=progress).run()
    assert len(checkpoint_of(output)["history"]) == 4
    job(folder, output).run(resume=True)
    assert_same_state(output, whole)


@pytest.mark.usefixtures("no_results")
def test_error_within_an_update_keeps_the_checkpoint_before(
    folder, tmp_path, monkeypatch
):
    from mi_nerfattack.attack import gradient

    original = gradient.Adam.step
    calls = []

    def fail_after(self, *arguments, **more):
        original(self, *arguments, **more)
        calls.append(1)
        if len(calls) == 5:
            raise MemoryError

    whole, output = tmp_path / "whole", tmp_path / "run"
    job(folder, whole).run()
    with monkeypatch.context() as patch:
        patch.setattr(gradient.Adam, "step", fail_after)
        with pytest.raises(MemoryError):
            job(folder, output).run()
    assert len(checkpoint_of(output)["history"]) == 3
    job(folder, output).run(resume=True)
    assert_same_state(output, whole)


def test_held_interrupt_waits_for_a_good_place():
    reached = []
    with pytest.raises(KeyboardInterrupt), held_interrupts() as check:
        signal.raise_signal(signal.SIGINT)
        reached.append("after the signal")
        check()
        reached.append("after the check")
    assert reached == ["after the signal"]
    with pytest.raises(KeyboardInterrupt), held_interrupts():
        signal.raise_signal(signal.SIGINT)
        reached.append("no check")
    with pytest.raises(KeyboardInterrupt), held_interrupts():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        reached.append("after the second")
    assert reached == ["after the signal", "no check"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_random_generators_go_on_where_they_were():
    random.gauss(0, 1)
    np.random.normal()
    kept = determinism.random_states()

    def draw():
        numpy = np.random.normal(size=3).tolist()
        return random.gauss(0, 1), random.random(), numpy, torch.rand(3).tolist()

    expected = draw()
    assert draw() != expected
    determinism.restore_random_states(kept)
    assert draw() == expected


def test_deterministic_mode_is_of_one_thread_and_ends():
    import drjit as dr

    before = dr.thread_count(), torch.get_num_threads()
    with determinism.deterministic():
        assert (dr.thread_count(), torch.get_num_threads()) == (1, 1)
        assert torch.are_deterministic_algorithms_enabled()
    assert (dr.thread_count(), torch.get_num_threads()) == before
    assert not torch.are_deterministic_algorithms_enabled()


def test_deterministic_mode_refuses_a_gpu(monkeypatch):
    import drjit as dr

    monkeypatch.setattr(dr, "backend_v", lambda _: dr.JitBackend.CUDA)
    with pytest.raises(SetupError, match="deterministic"), determinism.deterministic():
        pass


def test_partial_files_of_writers_are_removed_and_no_others(tmp_path):
    (tmp_path / "objects").mkdir()
    mine = [tmp_path / ".hidden.tmp", tmp_path / "a.0123456789ab.tmp"]
    stale = [
        tmp_path / ".checkpoint.safetensors.0123456789ab.tmp",
        tmp_path / "objects" / ".ball.safetensors.ba9876543210.tmp",
    ]
    for path in (*mine, *stale):
        path.write_text("")
    assert sorted(folders.remove_partial(tmp_path)) == sorted(stale)
    assert all(path.exists() for path in mine)


def test_differences_are_told_key_by_key():
    def file(name, digest):
        return json.dumps({"file": name, "sha256": digest})

    kept = {"same": "1", "gone": "2", "moved": file("a", "1"), "new": file("b", "1")}
    present = {"same": "1", "moved": file("z", "1"), "new": file("b", "2"), "add": "3"}
    assert resumable.differences(kept, present) == [
        "new: the content of b has changed",
        "add: (none) -> 3",
        "gone: 2 -> (none)",
    ]


def test_scene_counts_with_the_meshes_that_it_names(folder, tmp_path):
    from mi_nerfattack.scenario import load_scenario

    mine = tmp_path / "mine"
    shutil.copytree(folder, mine)
    mesh = mine / "road.ply"
    mesh.write_text("one")
    xml = (mine / "deployment.xml").read_text()
    shape = '<shape type="ply"><string name="filename" value="road.ply"/></shape>'
    (mine / "deployment.xml").write_text(xml.replace("<emitter", f"{shape}<emitter"))
    scenario, _ = load_scenario(mine / "scenario.toml")
    before = scenario.identity(mine)
    mesh.write_text("other")
    assert resumable.differences(before, scenario.identity(mine)) == [
        "scenario.scene.deployment: the content of deployment.xml has changed"
    ]


def test_force_without_resume_is_refused(folder, tmp_path, capsys):
    from mi_nerfattack import cli

    scenario, output = str(folder / "scenario.toml"), tmp_path / "run"
    assert cli.main(["attack", scenario, "-o", str(output), "--force"]) == 2
    assert "--resume" in capsys.readouterr().err and not output.exists()


@pytest.mark.slow
def test_killed_attacks_go_on(tmp_path):
    from mi_nerfattack.bench.kill import Campaign

    document = Campaign(tmp_path, 5, 0).run()
    assert document["kills"] == 5 and not document["failures"]
