"""Folders of tiny scenarios, and attacks that write no results."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import pytest
from support.worlds import attacks as attack_jobs
from support.worlds import loops as toy

from mi_nerfattack.experiment import results
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.io import files
from mi_nerfattack.scenario.scenario import load_scenario

_POLICY = """\
[policy]
file = "smooth.py:SmoothPolicy"
trust_code = true
goal = { kind = "integer", count = 3 }
"""
#: The camera of the toy loop's policy.
CAMERA = f"[camera]\nwidth = {toy.WIDTH}\nheight = {toy.HEIGHT}\n[drive]"
_CHANGES = {
    '[policy]\nfile = "policy.safetensors"\n': _POLICY,
    "[drive]": CAMERA,
    "max_iterations = 30": "max_iterations = 2",
    "textures = 4": "textures = 2",
    "[7.0, 4.2, 1.6]": "[-15.0, 2.6, 1.6]",
}
_POSES = '[attack]\nfreedom.kind = "both"\nfreedom.pose_limit_m = 0.2\n'


@pytest.fixture(scope="module")
def scenario_folder(tmp_path_factory):
    """A scenario for the command line."""
    mi.set_variant("llvm_ad_rgb")
    changes = {
        "horizon = 2": "horizon = 4",
        "max_iterations = 30": "max_iterations = 3",
        "checkpoint_every = 3\ndeterministic = true": "checkpoint_every = 1",
        "[baseline]\ntextures = 4\n": "",
    }
    return attack_jobs.write_scenario(tmp_path_factory.mktemp("scenario"), changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario for jobs with the toy loop's policy."""
    mi.set_variant("llvm_ad_rgb")
    changes = {
        "max_iterations = 30": "max_iterations = 6",
        "textures = 4": "textures = 2",
        "[drive]": CAMERA,
    }
    return attack_jobs.write_scenario(tmp_path_factory.mktemp("scenario"), changes)


def leave_out_results(monkeypatch):
    def only_numbers(output, done, effort, *arguments):
        cost = effort().model_dump()
        files.write_json(output / "metrics.json", {"cost": cost})
        metrics = {"ignored_changes": done.ignored, "flags": done.flags}
        metrics["curve"] = done.curve
        return {"cost": cost, "drives": done.drives, **metrics}

    monkeypatch.setattr(results, "write_results", only_numbers)


@pytest.fixture
def no_results(monkeypatch):
    """Leave out plots and pages, which take seconds."""
    leave_out_results(monkeypatch)


@pytest.fixture(scope="module")
def uninterrupted(folder, tmp_path_factory):
    """The folder of a job that nothing interrupted, and what it returned."""
    output = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        leave_out_results(patch)
        return output, attack_jobs.job(folder, output).run()


def write_found(folder: Path) -> Path:
    """Write a scenario of which poses and textures are attacked; return its file."""
    attack_jobs.write_scenario(folder, _CHANGES)
    attack_jobs.make_dense(folder)
    (folder / "smooth.py").write_text("from support.worlds.loops import SmoothPolicy\n")
    path = folder / "scenario.toml"
    path.write_text(path.read_text().replace("[attack]", _POSES))
    return path


@pytest.fixture(scope="session")
def found_run(tmp_path_factory) -> Path:
    """The folder of a finished attack of poses and texture, without pictures."""
    mi.set_variant("llvm_ad_rgb")
    path = write_found(tmp_path_factory.mktemp("scenario"))
    scenario, text = load_scenario(path)
    output = path.parent / "run"
    Job(scenario, text, scenario.build_policy(), output, frames=None).run(anyway=True)
    return output
