"""Tiny attacks that are interrupted and resumed: a scenario, jobs, their files."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers import toy_loop as toy

from mi_nerfattack.io import files

CHANGES = {
    "horizon = 2": "horizon = 2",
    "iterations = 30": "iterations = 6",
    "textures = 4": "textures = 2",
    "[drive]": f"[camera]\nwidth = {toy.WIDTH}\nheight = {toy.HEIGHT}\n[drive]",
}
STAGES = ("unperturbed", "random", "gradient")


@pytest.fixture(scope="module", name="folder")
def make_folder(tmp_path_factory):
    """A scenario of tiny fields."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from bench.kill.scenario import SCENARIO, make_scenario

    path = tmp_path_factory.mktemp("scenario")
    make_scenario(path)
    text = SCENARIO
    for old, new in CHANGES.items():
        assert old in text
        text = text.replace(old, new)
    (path / "scenario.toml").write_text(text)
    return path


@pytest.fixture(name="no_results")
def leave_out_results(monkeypatch):
    """Leave out plots and pages, which take seconds."""
    from mi_nerfattack.experiment import results

    def only_numbers(
        output, world, drives, attack, textures, text, cost, ignored, *more
    ):
        document = {"cost": cost, "ignored_changes": ignored, "drives": drives}
        files.write_json(output / "metrics.json", {"cost": cost})
        return document

    monkeypatch.setattr(results, "write_results", only_numbers)


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


def interrupt(folder, output, stage, step, resume=False, **more):
    with pytest.raises(KeyboardInterrupt):
        job(folder, output, on_progress=stop_at(stage, step), **more).run(resume)


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
