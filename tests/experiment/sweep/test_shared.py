"""Drives that cells have in common: done once, and equal to those of a cell alone."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.kept_drives import SharedDrives
from mi_nerfattack.experiment.sweep.cell import folder_of, run_cell
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.world import Appearance, build_world

pytestmark = pytest.mark.usefixtures("variant")

GRID = """\
scenario = "scenario.toml"
budgets = [120]

[[methods]]
name = "blocks"
set.attack = { method = "blocks", deterministic = true }
set.baseline.textures = 2

[[methods]]
name = "random"
set.attack = { method = "random", deterministic = true }
set.baseline.textures = 2
"""


@pytest.fixture
def cells(scenario_folder):
    """Return two cells that differ by their method alone."""
    path = scenario_folder / "shared.toml"
    path.write_text(GRID)
    return load_cells(path)


def test_drives_of_another_cell_are_those_of_a_cell_alone(cells, tmp_path, no_results):
    first, second = cells
    steps = {"together": 0, "alone": 0}

    def count(where):
        def on_step():
            steps[where] += 1

        return on_step

    together, alone = tmp_path / "together", tmp_path / "alone"
    run_cell(first, together, lambda: None)
    made = {path.name for path in (together / "shared").iterdir()}
    run_cell(second, together, count("together"))
    run_cell(second, alone, count("alone"))
    assert {path.name for path in (together / "shared").iterdir()} == made
    assert {path.name for path in (alone / "shared").iterdir()} == made
    drives = {path.name for path in (folder_of(alone, second) / "drives").iterdir()}
    for name in drives:
        one, other = (
            files.read_safetensors(folder_of(sweep, second) / "drives" / name)[0]
            for sweep in (together, alone)
        )
        assert one.keys() == other.keys()
        assert all((one[key] == other[key]).all() for key in one)
    horizon = second.scenario.drive.horizon
    unshared = [name for name in drives if ATTACK in name]
    saved = steps["alone"] - steps["together"]
    assert saved == horizon * (len(drives) - len(unshared) - 2)


def test_what_decides_about_a_drive_tells_it_apart(cells, tmp_path):
    first, second = (cell.scenario for cell in cells)
    world = build_world(first, first.build_policy())
    look = world.appearance()
    shared = SharedDrives(tmp_path)

    def path(world=world, label="surrogate", look: Appearance | None = look, run=0):
        return shared.unit(world, label, look, run).path

    assert path() == path(replace(world, scenario=second))
    moved = replace(look, offsets=look.offsets + 0.1)
    painted = replace(look, textures=[value + 1 for value in look.textures])
    jittered = first.attack.model_copy(update={"jitter": not first.attack.jitter})
    others = {
        path(look=None),
        path(look=moved),
        path(look=painted),
        path(run=1),
        path(replace(world, initial=world.initial + 0.5)),
        path(replace(world, scenario=first.model_copy(update={"seed": 9}))),
        path(replace(world, scenario=first.model_copy(update={"attack": jittered}))),
        *(path(label=label) for label in world.deployments),
    }
    assert len(others) == 7 + len(world.deployments) and path() not in others


def test_a_damaged_drive_is_told(cells, tmp_path):
    scenario = cells[0].scenario
    world = build_world(scenario, scenario.build_policy())
    unit = SharedDrives(tmp_path).unit(world, "surrogate", None, 0)
    unit.path.write_bytes(b"no drive")
    with pytest.raises(InputError, match=unit.path.name):
        unit.read()
