"""Attacks that are interrupted and go on; the deterministic mode."""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers.attack_jobs import (
    ROBUST,
    STAGES,
    assert_same_drives,
    assert_same_state,
    checkpoint_of,
    interrupt,
    job,
    stop_at,
)

from mi_nerfattack.backend import determinism
from mi_nerfattack.backend.interrupts import held_interrupts
from mi_nerfattack.errors import InputError, SetupError

pytestmark = pytest.mark.usefixtures("variant")


FIFTY = (  # without converging before
    "max_iterations = 6\nlearning_rate = 0.5",
    "max_iterations = 50\nlearning_rate = 0.02" + ROBUST,
)


@pytest.mark.usefixtures("no_results")
def test_interrupted_deterministic_run_ends_bit_for_bit_as_the_whole(folder, tmp_path):
    whole, output = tmp_path / "whole", tmp_path / "run"
    expected = job(folder, whole, FIFTY).run()
    # 4 steps an iteration: in the drive, and in the derivative
    for step in (4 * 17 + 1, 4 * 32 + 3):
        interrupt(folder, output, "surrogate: optimisation", step, change=FIFTY)
        iteration = len(checkpoint_of(output)["history"])
        assert iteration == step // 4
    result = job(folder, output, FIFTY).run()
    assert len(checkpoint_of(output)["history"]) == 50
    assert_same_state(output, whole)
    assert_same_drives(result["drives"], expected["drives"])
    assert result["curve"] == expected["curve"]
    assert len(result["curve"]["frames"]) == 51  # what the last update gave, too
    assert result["cost"]["processes"] == 3
    assert 0 < result["cost"]["checkpoint_s"] < result["cost"]["wall_s"]


@pytest.mark.usefixtures("no_results")
def test_what_is_finished_is_not_repeated(folder, whole, tmp_path):
    output, seen = tmp_path / "run", []
    interrupt(folder, output, "surrogate: random", 7)  # 2 of 2, judged, in the drive
    interrupt(folder, output, "deployment: attack", 1)
    before = checkpoint_of(output)
    written = {path: path.stat().st_mtime_ns for path in output.glob("drives/*")}
    # 2 of each case twice, but for the last
    assert len(written) == 18

    def watch(stage, done, total, remark):
        seen.append((stage, done, remark))

    document = job(folder, output, on_progress=watch).run()
    driven = [line for line in seen if line[2] != "kept"]
    assert driven == [("deployment: attack", k, "") for k in (1, 2, 3, 4)]
    kept = {stage for stage, _, remark in seen if remark == "kept"}
    assert kept == {
        f"{place}: {stage}"
        for place in ("surrogate", "deployment")
        for stage in STAGES
        if (place, stage) != ("deployment", "attack")
    }
    for name, value in checkpoint_of(output).items():
        assert np.array_equal(value, before[name], equal_nan=True), name
    assert len(list(output.glob("drives/*"))) == 20
    assert all(path.stat().st_mtime_ns == time for path, time in written.items())
    # 2 of each case, twice, 2 judged, the attack; drives that were cut short too
    assert document["cost"]["renders"] >= 2 * (10 + 10 + 2) + 6 * 2 * 2
    assert_same_drives(document["drives"], whole[1]["drives"])


@pytest.mark.usefixtures("no_results")
def test_finished_run_is_resumed_without_a_drive(folder, whole, tmp_path):
    output, seen = tmp_path / "run", []
    shutil.copytree(whole[0], output)

    def watch(stage, done, total, remark):
        seen.append(remark)

    job(folder, output, on_progress=watch).run()
    assert set(seen) == {"kept"}


@pytest.mark.usefixtures("no_results")
def test_interrupt_within_a_step_leaves_a_whole_state(folder, whole, tmp_path):
    output = tmp_path / "run"

    def press():
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        progress = stop_at("surrogate: optimisation", 4 * 4 + 4, press)
        job(folder, output, on_progress=progress).run()
    assert len(checkpoint_of(output)["history"]) == 4
    job(folder, output).run()
    assert_same_state(output, whole[0])


@pytest.mark.usefixtures("no_results")
def test_error_within_an_update_keeps_the_checkpoint_before(
    folder, whole, tmp_path, monkeypatch
):
    from mi_nerfattack.attack import gradient

    original = gradient.Adam.step
    calls = []

    def fail_after(self, *arguments, **more):
        original(self, *arguments, **more)
        calls.append(1)
        if len(calls) == 5:
            raise MemoryError

    output = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(gradient.Adam, "step", fail_after)
        with pytest.raises(MemoryError):
            job(folder, output).run()
    assert len(checkpoint_of(output)["history"]) == 3
    job(folder, output).run()
    assert_same_state(output, whole[0])


@pytest.mark.usefixtures("no_results")
def test_gradient_that_is_not_finite_costs_no_iteration(folder, tmp_path, monkeypatch):
    from mi_nerfattack.rollout.function import Rollout

    original, calls = Rollout.gradient, []

    def spoil(self, *arguments, **more):
        found = original(self, *arguments, **more)
        calls.append(1)
        if len(calls) == 6:
            found.textures[0][:] = float("nan")
        return found

    output = tmp_path / "run"
    monkeypatch.setattr(Rollout, "gradient", spoil)
    with pytest.raises(InputError, match=r"iteration 5: the gradient of object 0"):
        job(folder, output).run()
    monkeypatch.undo()
    assert len(checkpoint_of(output)["history"]) == 5  # checkpoint_every = 3
    job(folder, output).run()
    assert len(checkpoint_of(output)["history"]) == 6


def test_handlers_of_others_are_not_held(monkeypatch):
    heard = []
    before = signal.signal(signal.SIGTERM, lambda *_: heard.append("told"))
    try:
        with held_interrupts():
            signal.raise_signal(signal.SIGTERM)
            assert heard == ["told"]
    finally:
        signal.signal(signal.SIGTERM, before)


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


@pytest.mark.slow
def test_killed_attacks_go_on(tmp_path):
    """In an interpreter of its own, since it forks: threads would be lost."""
    output = tmp_path / "kills.json"
    arguments = ["--kills", "3", "--seed", "0", "--output", str(output)]
    command = [sys.executable, "-m", "bench.kill.run", *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert result.returncode == 0, result.stdout + result.stderr
    document = json.loads(output.read_text())
    assert document["kills"] == 3 and not document["failures"]
