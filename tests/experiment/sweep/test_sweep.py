"""Which cells are done, how often, what they share, and what the table says of them."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.faults.refusals import refused_at

from mi_nerfattack.drives.store import Store, drive_files, read_drive
from mi_nerfattack.drives.table import read_csv, records, write_csv
from mi_nerfattack.errors import InputError, RefusedError
from mi_nerfattack.experiment.cases import Cases
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.experiment.sweep.cell import folder_of, is_complete, run_cell
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.experiment.sweep.summary import Taken, read_taken, write_summary
from mi_nerfattack.experiment.sweep.sweep import Cells, Sweep
from mi_nerfattack.experiment.sweep.table import (
    COLUMNS,
    make_table,
    read_made,
    read_table,
    write_table,
)
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.world import Appearance, build_world
from mi_nerfattack.system.workers import InThisProcess, _failed, failure
from tests.experiment.sweep.conftest import finish

pytestmark = pytest.mark.usefixtures("variant")


def sweep(cells, folder, task):
    swept = Sweep(Cells(tuple(cells), folder, task=task))
    swept.run(InThisProcess())
    return swept


def table(folder):
    return records(read_table(folder / "results.csv")[list(COLUMNS)])


class Tasks:
    """Does cells, and fails as often as is told by seed."""

    def __init__(self, failures=()):
        self.failures = dict(failures)
        self.done = []

    def __call__(self, cell, folder, on_step):
        self.done.append(cell.seed)
        on_step()
        if self.failures.get(cell.seed, 0) > 0:
            self.failures[cell.seed] -= 1
            raise InputError(f"seed {cell.seed}: is unlucky")
        if self.failures.get(cell.seed) == -1:
            raise KeyboardInterrupt
        finish(cell, folder)


def figures_of(cell):
    """Return the row of the drive that `finish` makes."""
    labels = {"cell": cell.id, "route": "line", "objects": "ball", "seed": cell.seed}
    labels |= {"method": "gradient", "budget": None, "environment": "surrogate"}
    labels |= {"case": "attack", "run": 0, "frames": 40, "steps": 30}
    figures = {"cross_track_mean_m": 0.1 * cell.seed, "wheel_out_s": 1.5}
    return labels | figures | {"departed": True, "status": "complete", "error": None}


def test_the_table(cells, tmp_path):
    swept = sweep(cells, tmp_path, Tasks())
    assert swept.steps == 4 and not swept.errors
    assert table(tmp_path) == [figures_of(cell) for cell in cells]
    assert read_made(tmp_path) == {
        cell.id: {
            "digests": cell.scenario.digests(),
            "versions": {"numpy": "2"},
            "scenario": cell.text,
        }
        for cell in cells
    }
    totals = read_table(tmp_path / "results.csv")["cross_track_total"]
    assert totals.tolist() == [30 * (0.1 * seed) for seed in range(4)]


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (",run,", ",number,", "number, run"),
        (",30,", ",many,", "damaged"),
        (",30,", ",,", "damaged"),
        (",complete,", ",,", "damaged"),
        (",complete,\n", ",compl", "last line"),
        ("cell,", '"cell,', "table"),
    ],
)
def test_other_tables_are_refused(cells, tmp_path, old, new, named):
    write_table(tmp_path, [figures_of(cells[0])], {})
    path = tmp_path / "results.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with refused_at(path, named):
        read_table(path)


def test_numbers_and_texts_come_back_as_they_were(tmp_path):
    """Floats to the bit; commas, quotes and lines in texts, and words like NA."""
    powers = 10.0 ** np.arange(-100, 100)
    values = np.random.default_rng(0).standard_normal(200) * powers
    labels = {"cell": 'a, "b"\nc', "route": "NA", "seed": 2**60}
    rows = [labels | {"cross_track_mean_m": value} for value in values.tolist()]
    write_csv(tmp_path / "table.csv", make_table(rows))
    restored = records(read_csv(tmp_path / "table.csv", COLUMNS))
    assert restored == records(make_table(rows))
    assert [row["cross_track_mean_m"] for row in restored] == values.tolist()
    assert all(row[name] == value for row in restored for name, value in labels.items())


def test_failed_cells_are_tried_twice_more_and_stay_as_rows(cells, tmp_path):
    first = Tasks({1: 2, 2: 9})
    swept = sweep(cells, tmp_path, first)
    assert first.done == [0, 1, 2, 3, 1, 2, 1, 2]
    assert list(swept.errors) == [2]
    rows = {row["seed"]: row for row in table(tmp_path)}
    assert [rows[seed]["status"] for seed in range(4)] == [
        *("complete", "complete", "failed", "complete")
    ]
    assert rows[2]["error"] == "seed 2: is unlucky" and rows[2]["departed"] is None
    interrupted = Tasks({2: -1})  # before the next try of it ends
    with pytest.raises(KeyboardInterrupt):
        sweep(cells, tmp_path, interrupted)
    assert table(tmp_path)[2]["error"] == "seed 2: is unlucky"
    (tmp_path / "results.csv").unlink()  # it is made of the cells
    last = Tasks()
    again = sweep(cells, tmp_path, last)
    assert last.done == [2] and again.already_complete == 3 and not again.errors
    assert [row["status"] for row in table(tmp_path)] == ["complete"] * 4
    assert not list((tmp_path / "failed").iterdir())


def test_a_cell_that_would_prove_nothing_is_refused_once(cells, tmp_path):
    done = []

    def task(cell, folder, on_step):
        done.append(cell.seed)
        if cell.seed == 1:
            raise RefusedError("an attack would prove nothing")
        finish(cell, folder)

    swept = sweep(cells, tmp_path, task)
    assert done == [0, 1, 2, 3] and list(swept.errors) == [1]
    assert table(tmp_path)[1]["error"] == "an attack would prove nothing"
    # from process to process
    assert isinstance(failure(0, _failed(RefusedError("no"))), RefusedError)
    assert not isinstance(failure(0, _failed(InputError("no"))), RefusedError)


def test_cells_of_another_grid_are_not_in_the_table(cells, tmp_path):
    sweep(cells[:2], tmp_path, Tasks())
    tasks = Tasks()
    sweep(cells[1:3], tmp_path, tasks)
    assert tasks.done == [2]
    assert [row["seed"] for row in table(tmp_path)] == [1, 2]


def test_a_cell_whose_files_are_on_another_disk_has_failed(cells, tmp_path):
    swept = sweep(cells[:1], tmp_path, lambda cell, folder, on_step: None)
    assert "disk that all machines share" in swept.errors[0]


def test_a_cell_is_refused_where_its_files_are_others(cells, tmp_path):
    other = replace(cells[0], digests=cells[0].digests | {"scene.routes": "0"})
    with pytest.raises(InputError, match="scene.routes: other"):
        run_cell(other, tmp_path, lambda: None)
    assert not folder_of(tmp_path, other).exists()


def test_a_cell_that_was_forced_is_not_complete(cells, tmp_path, monkeypatch):
    monkeypatch.setattr(Job, "run_claimed", lambda self, anyway: {"flags": []})
    with refused_at(f"{cells[0].id}", "--force", "remove the folder"):
        run_cell(cells[0], tmp_path, lambda: None)
    assert not is_complete(tmp_path, cells[0])


GRID = """\
scenario = "scenario.toml"
budgets = [120]

[[methods]]
name = "blocks"
set.attack = { method.kind = "blocks", deterministic = true }
set.baseline.textures = 2

[[methods]]
name = "random"
set.attack = { method.kind = "random", deterministic = true }
set.baseline.textures = 2
"""


@pytest.fixture
def methods(scenario_folder):
    """Return two cells that differ by their method alone."""
    path = scenario_folder / "shared.toml"
    path.write_text(GRID)
    return load_cells(path)


def test_shared_drives_are_those_of_a_cell_alone(methods, tmp_path, no_results):
    first, second = methods
    steps = {"together": [], "alone": []}

    def shared_by(sweep):
        return {path.name for path in drive_files(sweep / "shared")}

    together, alone = tmp_path / "together", tmp_path / "alone"
    run_cell(first, together, lambda: None)
    made = shared_by(together)
    for sweep in (together, alone):
        run_cell(second, sweep, lambda name=sweep.name: steps[name].append(0))
    own = {name for name in shared_by(together) if name.startswith(ATTACK)}
    assert shared_by(together) == made | own
    assert shared_by(alone) - own == {name for name in made if ATTACK not in name}
    saved, folders = 0, [folder_of(sweep, second) for sweep in (together, alone)]
    pairs = [drive_files(folder / "drives") for folder in folders]
    for one, other in zip(*pairs, strict=True):
        assert one.name == other.name
        first_drive, second_drive = read_drive(one).arrays(), read_drive(other).arrays()
        assert all((first_drive[k] == second_drive[k]).all() for k in first_drive)
        saved += second.scenario.drive.horizon * (not one.name.startswith(ATTACK))
    assert len(steps["alone"]) - len(steps["together"]) == saved
    written = folders[0] / "cell.json"
    record, time = files.read_json(written), written.stat().st_mtime_ns
    assert record["digests"] == second.digests and "mitsuba" in record["versions"]
    # a cell that is complete is not done again
    run_cell(second, together, lambda: None)
    assert is_complete(together, second) and written.stat().st_mtime_ns == time


def test_what_decides_about_a_drive_tells_it_apart(methods, tmp_path):
    first, second = (cell.scenario for cell in methods)
    world = build_world(first, first.build_policy())
    look = world.appearance()

    def digest(world=world, label="surrogate", look: Appearance | None = look, run=0):
        identity, quiet = world.scenario.identity(), lambda *report: None
        cases = Cases(world, Store(tmp_path), identity, quiet, quiet)
        cases.looks["own"] = look
        return cases.of_case(label, "own")[run].digest

    assert digest() == digest(replace(world, scenario=second))
    moved = replace(look, offsets=look.offsets + 0.1)
    painted = replace(look, textures=[value + 1 for value in look.textures])
    jittered = first.attack.model_copy(update={"jitter": not first.attack.jitter})
    others = {
        digest(look=None),
        digest(look=moved),
        digest(look=painted),
        digest(run=1),
        digest(replace(world, initial=world.initial + 0.5)),
        digest(replace(world, scenario=first.model_copy(update={"seed": 9}))),
        digest(replace(world, scenario=first.model_copy(update={"attack": jittered}))),
        *(digest(label=label) for label in world.deployments),
    }
    assert len(others) == 7 + len(world.deployments) and digest() not in others


NOTHING = Taken()


def sweep_taking(cells, folder, taken=NOTHING):
    """Do cells by a stand-in; returns those that were done, and the summary."""
    done = []

    def task(cell, folder, on_step):
        done.append(cell.seed)
        if cell.seed == 3 and not taken.rows:
            raise InputError("is unlucky")
        finish(cell, folder)

    Sweep(Cells(tuple(cells), folder, task=task), taken=taken).run(InThisProcess())
    return done, write_summary(folder, taken.attacks)


@pytest.fixture
def elsewhere(cells, tmp_path):
    """Return table and summary of a sweep whose last cell failed; no folders."""
    folder = tmp_path / "elsewhere"
    sweep_taking(cells, folder)
    shutil.rmtree(folder / "cells")
    return folder


def test_complete_cells_are_not_done_again(cells, elsewhere, tmp_path):
    reference, again = tmp_path / "whole", tmp_path / "again"
    other = replace(cells[2], digests={"scenario": "0123456789abcdef"})
    changed = [*cells[:2], other, cells[3]]
    done, summary = sweep_taking(changed, again, read_taken([elsewhere]))
    assert done == [2, 3]  # another cell, and the one that had failed
    assert not folder_of(again, cells[0]).exists()
    _, alone = sweep_taking(changed, reference, Taken(rows={"none": []}))
    assert summary == alone and len(summary["attacks"]) == 4
    for name in ("results.csv", "cells.json"):
        assert (again / name).read_text() == (reference / name).read_text()
    made = read_made(again)
    assert {name: record["scenario"] for name, record in made.items()} == {
        cell.id: cell.text for cell in changed
    }
    # what was taken stays told where the folder's own summary is all that there is
    assert write_summary(again) == summary


def test_the_first_folder_that_has_a_cell_counts(cells, elsewhere, tmp_path):
    second = tmp_path / "second"
    _, summary = sweep_taking(cells, second, Taken(rows={"none": []}))
    taken = read_taken([elsewhere, second])
    assert taken.rows.keys() == {cell.id for cell in cells}
    assert taken.attacks.keys() == {one["cell"] for one in summary["attacks"]}
    (elsewhere / "summary.json").unlink()
    assert read_taken([elsewhere]).attacks == {}
    files.write_json(elsewhere / "summary.json", {"schema": 0})
    nowhere = tmp_path / "nowhere"
    wrong = {nowhere: nowhere / "results.csv", elsewhere: elsewhere / "summary.json"}
    for folder, where in wrong.items():
        with refused_at(where):
            read_taken([folder])
