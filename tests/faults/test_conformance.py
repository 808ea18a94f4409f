"""Every command that can be disturbed, times everything that can happen to it."""

from __future__ import annotations

import getpass
import itertools
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from support.faults.injected import (
    Killed,
    Watch,
    copy_and_die,
    have_no_memory,
    have_no_space,
    kind_of,
    obeyed_modes,
)

from mi_nerfattack import cli
from mi_nerfattack.commands import COMMANDS, PACKAGES, each
from mi_nerfattack.extras import OPTIONAL
from mi_nerfattack.io import locks
from tests.faults.jobs import EVENTS, JOBS, WRITERS
from tests.faults.running import Runner, partial_files, times

pytestmark = pytest.mark.usefixtures("variant")

SCENES = Path(__file__).parents[2] / "scenes"
LOCKED = "another process works in it; wait for it or end it"
FORBIDDEN = "permission denied; check the owner"
LEFT = "left"  # copy of what a killed process leaves
FAULTS = {
    "full disk": have_no_space,
    "SIGTERM": partial(signal.raise_signal, signal.SIGTERM),
    "Ctrl-C": partial(signal.raise_signal, signal.SIGINT),
    "too little memory": have_no_memory,
}


def parametrised(names):
    return [
        pytest.param(name, marks=[pytest.mark.slow] * JOBS[name].slow) for name in names
    ]


@pytest.fixture(scope="module", params=parametrised(JOBS))
def runner(request, start) -> Runner:
    return start(request.param)


def faults(runner: Runner, event: str) -> list[Watch]:
    """Return a fault at each of a few places; all events together reach every place."""
    drawn, lasts = random.Random(f"{runner.name}, {event}"), event == "full disk"
    counts = getattr(runner.watch, EVENTS[event].places) or runner.watch.files
    step = -(-len(counts) // runner.job.places)
    fault = FAULTS.get(event, partial(copy_and_die, runner.folder, runner.base / LEFT))
    return [
        Watch(fault, place, drawn.randint(1, counts[place]), drawn.random(), lasts)
        for place in list(counts)[[*EVENTS].index(event) % step :: step]
    ]


@pytest.mark.parametrize("event", EVENTS)
def test_a_disturbed_job_goes_on_to_the_same_bits(runner, event, capsys):
    job, times_ns = runner.job, {}
    folder = runner.begin()
    for watch in faults(runner, event):
        capsys.readouterr()
        if EVENTS[event].code is None:
            with pytest.raises(Killed):
                runner.run(watch)
            runner.put(runner.base / LEFT)
            for path in (runner.base / LEFT, runner.scratch):
                shutil.rmtree(path)
        else:
            code = runner.run(watch)
            check_end(runner, event, code, capsys.readouterr().err)
        assert watch.met, watch
        assert times(folder, job.keeps).items() >= times_ns.items(), watch
        times_ns = times(folder, job.keeps)
    again = Watch()
    runner.finish(again)
    for kind, count in Counter(kind_of(path.name) for path in times_ns).items():
        assert again.files.get(kind, 0) + count == runner.watch.files[kind]
    left = set(partial_files(folder))
    assert left.issubset(folder.glob(job.leaves) if job.leaves else ())


def check_end(runner: Runner, event: str, code: int, error: str) -> None:
    """Check the exit code, the line that says why, and that nothing is half written."""
    assert partial_files(runner.folder) == []
    left = {path.name for path in runner.scratch.iterdir()}
    assert left <= {f"torchinductor_{getpass.getuser()}"}  # PyTorch's own
    if event == "too little memory" and runner.job.retries:
        assert code == 0, error
        return
    assert code == EVENTS[event].code, error
    lines = [line for line in error.splitlines() if EVENTS[event].message in line]
    assert len(lines) == 1, error


def test_a_clock_that_jumps_changes_nothing(runner, monkeypatch):
    now, jumps = time.time, itertools.cycle([0.0, 86_400.0, -86_400.0])
    runner.begin()
    monkeypatch.setattr(time, "time", lambda: now() + next(jumps))
    runner.finish()


def is_refused(runner: Runner, message: str, capsys) -> None:
    """Check that the job is refused before it computes anything, and leaves nothing."""
    before, watch = sorted(runner.folder.rglob("*")), Watch()
    capsys.readouterr()
    assert runner.run(watch) == 2
    assert message in capsys.readouterr().err
    assert sorted(runner.folder.rglob("*")) == before
    assert not watch.files and not watch.stages


def empty(runner: Runner, check: str) -> Path:
    """Return the job's folder, without its inputs where the check comes before them."""
    folder = runner.begin()
    if check not in runner.job.reads:
        shutil.rmtree(folder)
        folder.mkdir()
        runner.patch.chdir(folder)
    return folder


def test_a_second_process_is_refused_before_it_computes(runner, capsys):
    if runner.job.claims:
        (empty(runner, "lock") / runner.job.claims).mkdir(parents=True)
        with locks.exclusive(runner.job.claims):
            is_refused(runner, LOCKED, capsys)


def test_a_folder_without_permission_is_told_before_it_computes(runner, capsys):
    folder = empty(runner, "mode")
    folder.chmod(0o555)
    try:
        with obeyed_modes():
            is_refused(runner, FORBIDDEN, capsys)
    finally:
        folder.chmod(0o755)


@pytest.mark.parametrize("words", WRITERS)
def test_a_command_that_writes_at_its_end_checks_first(
    words, tmp_path, monkeypatch, capsys
):
    """Before it reads anything that takes long; most inputs are missing."""
    monkeypatch.chdir(tmp_path)
    arguments, claimed = words.format(scenes=SCENES).split(), WRITERS[words]
    if claimed:
        Path(claimed).mkdir()
        with locks.exclusive(claimed):
            assert cli.main(arguments) == 2
        assert f"{claimed}: {LOCKED}" in capsys.readouterr().err
        Path(claimed).rmdir()
    tmp_path.chmod(0o555)
    try:
        with obeyed_modes():
            assert cli.main(arguments) == 2
    finally:
        tmp_path.chmod(0o755)
    assert FORBIDDEN in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_every_command_that_writes_is_tried():
    without_output = {("doctor",), ("car", "monitor"), ("car", "serve"), ("upgrade",)}
    all_words = [
        words.split() for words in (*WRITERS, *(j.words for j in JOBS.values()))
    ]
    commands = {names for names, _ in each(COMMANDS)}
    tried = {names for names in commands for words in all_words if begins(words, names)}
    assert tried == commands - without_output


def begins(words: list[str], names: tuple[str, ...]) -> bool:
    return tuple(words[: len(names)]) == names


BLOCKED = """
import sys
sys.path[:], blocked, words = {}, {}, {}
sys.modules.update(dict.fromkeys(blocked))
from mi_nerfattack.cli import main
sys.exit(main(words))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in JOBS if name != "train"])
def test_a_job_needs_only_the_packages_of_its_command(name, start):
    """But for `train`, whose job is small in this process alone."""
    runner = start(name)
    folder, words = runner.begin(), f"{runner.job.words} {runner.job.options}".split()
    kind = next(kind for names, kind in each(COMMANDS) if begins(words, names))
    needed = {*PACKAGES.get(kind, ()), *(["av"] if "a.mp4" in words else [])}
    code = BLOCKED.format(sys.path, sorted(OPTIONAL.keys() - needed), words)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_a_killed_process_leaves_what_the_suite_takes_it_to_leave(start):
    """SIGKILL in a process of its own, at the byte at which the suite copies."""
    runner = start("render path")
    fault = partial(copy_and_die, runner.begin(), runner.base / "copy")
    with pytest.raises(Killed):
        runner.run(Watch(fault, "frame_#.exr", share=0.3))
    folder = runner.begin()
    code = f"""
import os, signal, sys
sys.path[:] = {sys.path!r}
from support.faults.injected import Watch
from mi_nerfattack.cli import main
watch = Watch(lambda: os.kill(os.getpid(), signal.SIGKILL), "frame_#.exr", share=0.3)
with watch.watching():
    main({f"{runner.job.words} {runner.job.options}".split()!r})
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    sizes = [
        sorted((kind_of(path.name), path.stat().st_size) for path in place.rglob("*.*"))
        for place in (folder, runner.base / "copy")
    ]
    assert sizes[0] == sizes[1] and len(partial_files(folder)) == 1
    runner.finish()
    assert partial_files(folder) == []
