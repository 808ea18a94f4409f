"""Folders of tiny scenarios, and attacks that write no results."""

from __future__ import annotations

import mitsuba as mi
import pytest
from helpers import attack_jobs
from helpers import toy_loop as toy

from mi_nerfattack.io import files


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
    camera = f"[camera]\nwidth = {toy.WIDTH}\nheight = {toy.HEIGHT}\n[drive]"
    changes = {
        "max_iterations = 30": "max_iterations = 6",
        "textures = 4": "textures = 2",
        "[drive]": camera,
    }
    return attack_jobs.write_scenario(tmp_path_factory.mktemp("scenario"), changes)


def leave_out_results(monkeypatch):
    from mi_nerfattack.experiment import results

    def only_numbers(output, done, effort, *more):
        cost = effort().model_dump()
        files.write_json(output / "metrics.json", {"cost": cost})
        found = {"ignored_changes": done.ignored, "flags": done.flags}
        found["curve"] = done.curve
        return {"cost": cost, "drives": done.drives, **found}

    monkeypatch.setattr(results, "write_results", only_numbers)


@pytest.fixture
def no_results(monkeypatch):
    """Leave out plots and pages, which take seconds."""
    leave_out_results(monkeypatch)


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory):
    """The folder of a job that nothing interrupted, and what it returned."""
    output = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        leave_out_results(patch)
        return output, attack_jobs.job(folder, output).run()
