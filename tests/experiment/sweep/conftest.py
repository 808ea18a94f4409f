"""Cells of tiny scenarios, and a stand-in for what does them."""

from __future__ import annotations

import json

import pytest

from mi_nerfattack.experiment.sweep.cell import COMPLETE, PROVENANCE, folder_of
from mi_nerfattack.experiment.sweep.grid import load_cells

GRID = """\
scenario = "scenario.toml"
seeds = [3, 4]
budgets = [40]
backward_multiple = 1.5

[[routes]]
name = "near"

[[routes]]
name = "far"
set.drive.horizon = 5

[[objects]]
name = "ball"
set.objects = [
    {id = "ball", field = "object.safetensors", position_m = [7.0, 4.2, 1.6]},
]

[[objects]]
name = "two"
routes = ["far"]
set.objects = [
    {id = "ball", field = "object.safetensors", position_m = [7.0, 4.2, 1.6]},
    {id = "other", field = "object.safetensors", position_m = [7.0, -4.2, 1.6]},
]

[[methods]]
name = "gradient"

[[methods]]
name = "blocks"
set.attack.method.kind = "blocks"
set.attack.method.first_block = 0.5
"""


@pytest.fixture(scope="module")
def cells(scenario_folder):
    """Four cells that differ in their seeds alone."""
    path = scenario_folder / "seeds.toml"
    path.write_text('scenario = "scenario.toml"\nseeds = [0, 1, 2, 3]\n')
    return load_cells(path)


@pytest.fixture
def write_grid(scenario_folder):
    """Return what writes a grid, with parts of its text made others."""

    def write(*changes):
        text = GRID
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path = scenario_folder / "grid.toml"
        path.write_text(text)
        return path

    return write


def finish(cell, sweep):
    """Write what a cell of one drive leaves."""
    output = folder_of(sweep, cell)
    output.mkdir(parents=True, exist_ok=True)
    drive = {"run": 0, "cross_track_mean_m": 0.1 * cell.seed, "wheel_out_s": 1.5}
    drive |= {"steps": 30, "steps_departed": 15}
    document = {
        "routes": {"line": {"surrogate": {"attack": {"per_run": [drive]}}}},
        "baseline": {"textures": 2},
        "curve": {"frames": [4, 16, 28, 40], "objective": [0, -1, -2, -3]},
        "scenario": {"attack": {"method": {"kind": cell.method}}},
        "converged": True,
        "flags": [],
    }
    (output / "metrics.json").write_text(json.dumps(document))
    (output / PROVENANCE).write_text(json.dumps({"versions": {"numpy": "2"}}))
    (output / COMPLETE).touch()
