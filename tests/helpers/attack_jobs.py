"""Tiny attacks that are interrupted and resumed: scenarios, jobs, their files."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from helpers import toy_loop as toy

from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import CASES

#: Keys of `[attack]` by which everything that can be drawn is.
ROBUST = """
poses = 3
jitter = true
exposure_ev_sd = 0.5
blur_px_sd = 0.8
noise_sd = 0.02
"""
STAGES = CASES


def write_scenario(folder, changes):
    """Write the scenario of tiny fields, with old parts of its text made new ones."""
    from bench.kill.scenario import SCENARIO, make_scenario

    make_scenario(folder)
    text = SCENARIO
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "scenario.toml").write_text(text)
    return folder


def run(*arguments, cwd, check):
    """Run the command line in a process of its own."""
    result = subprocess.run(
        [sys.executable, "-m", "mi_nerfattack.cli", *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert result.returncode == check, result.stderr
    assert "Traceback" not in result.stderr
    return result


def job(folder, output, change=("", ""), on_progress=None, notices=None):
    from mi_nerfattack.experiment.job import Job
    from mi_nerfattack.policy.torch_policy import TorchPolicy
    from mi_nerfattack.scenario.scenario import load_scenario

    text = (folder / "scenario.toml").read_text()
    assert change[0] in text
    path = folder / "changed.toml"
    text = text.replace(*change)
    if 'parameters = "pose"' in text:  # then the texture's rate has no meaning
        text = re.sub(r"(?m)^learning_rate = .*\n", "", text)
    path.write_text(text)
    scenario, text = load_scenario(path)
    result = Job(scenario, text, TorchPolicy(toy.SmoothPolicy()), output)
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


def interrupt(folder, output, stage, step, **more):
    with pytest.raises(KeyboardInterrupt):
        job(folder, output, on_progress=stop_at(stage, step), **more).run()


def checkpoint_of(output):
    tensors, _ = files.read_safetensors(output / "checkpoint.safetensors")
    return tensors


def contents(output):
    return {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}


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
