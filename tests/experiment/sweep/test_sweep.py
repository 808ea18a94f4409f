"""Which cells are done, how often, and what the table says of them."""

from __future__ import annotations

import json

import pytest

from mi_nerfattack.errors import InputError, RefusedError
from mi_nerfattack.experiment.sweep.cell import folder_of, is_complete, run_cell
from mi_nerfattack.experiment.sweep.sweep import Cells, Sweep
from mi_nerfattack.experiment.sweep.table import SCHEMA, read_table
from mi_nerfattack.io import files
from mi_nerfattack.system.workers import InThisProcess, _failed, failure
from tests.experiment.sweep.conftest import finish

parquet = pytest.importorskip(
    "pyarrow.parquet", reason="needs the extra 'sweep': pyarrow writes the table"
)
pytestmark = pytest.mark.usefixtures("variant")


def sweep(cells, folder, task):
    found = Sweep(Cells(tuple(cells), folder, task=task))
    found.run(InThisProcess())
    return found


def table(folder):
    return parquet.read_table(folder / "results.parquet").to_pylist()


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


def test_the_table(cells, tmp_path):
    found = sweep(cells, tmp_path, Tasks())
    assert found.steps == 4 and not found.errors
    stored = parquet.read_table(tmp_path / "results.parquet")
    assert stored.schema.names == list(SCHEMA)
    assert stored.schema.metadata[b"format"] == b"mi_nerfattack sweep 1"
    rows = stored.to_pylist()
    assert [row["seed"] for row in rows] == [0, 1, 2, 3]
    for cell, row in zip(cells, rows, strict=True):
        assert json.loads(row.pop("digests")) == cell.scenario.digests()
        assert json.loads(row.pop("versions")) == {"numpy": "2"}
        assert row.pop("scenario") == cell.text
        assert row == {
            "cell": cell.id,
            "route": "line",
            "objects": "ball",
            "method": "gradient",
            "budget": None,
            "seed": cell.seed,
            "environment": "surrogate",
            "case": "attack",
            "run": 0,
            "frames": 40,
            "steps": 30,
            "cross_track_mean_m": 0.1 * cell.seed,
            "wheel_out_s": 1.5,
            "departed": True,
            "status": "complete",
            "error": None,
        }


def test_a_table_is_read_and_others_refused(cells, tmp_path):
    sweep(cells[:1], tmp_path, Tasks())
    path, other = tmp_path / "results.parquet", tmp_path / "other.parquet"
    whole = table(tmp_path)
    assert read_table(path, ["cell", "scenario"]) == [
        {name: row[name] for name in ("cell", "scenario")} for row in whole
    ]
    assert "scenario" not in read_table(path)[0]
    raw = path.read_bytes()
    for damaged in (raw[:-300], b"PAR1" + bytes(100), b""):
        other.write_bytes(damaged)
        with pytest.raises(InputError, match="no Parquet file, or a damaged one"):
            read_table(other)
    stored = parquet.read_table(path)
    parquet.write_table(stored.replace_schema_metadata({}), other)
    with pytest.raises(InputError, match="not a sweep's table"):
        read_table(other)
    parquet.write_table(stored.drop_columns(["run"]), other)
    with pytest.raises(InputError, match="columns run are missing or others"):
        read_table(other)


def test_failed_cells_are_tried_twice_more_and_stay_as_rows(cells, tmp_path):
    first = Tasks({1: 2, 2: 9})
    found = sweep(cells, tmp_path, first)
    assert first.done == [0, 1, 2, 3, 1, 2, 1, 2]
    assert list(found.errors) == [2]
    rows = {row["seed"]: row for row in table(tmp_path)}
    assert [rows[seed]["status"] for seed in range(4)] == [
        *("complete", "complete", "failed", "complete")
    ]
    assert rows[2]["error"] == "seed 2: is unlucky" and rows[2]["departed"] is None
    interrupted = Tasks({2: -1})  # before the next try of it ends
    with pytest.raises(KeyboardInterrupt):
        sweep(cells, tmp_path, interrupted)
    assert table(tmp_path)[2]["error"] == "seed 2: is unlucky"
    last = Tasks()
    assert not sweep(cells, tmp_path, last).errors
    assert last.done == [2]
    assert [row["status"] for row in table(tmp_path)] == ["complete"] * 4
    assert not list((tmp_path / "failed").iterdir())


def test_a_cell_that_would_prove_nothing_is_refused_once(cells, tmp_path):
    done = []

    def task(cell, folder, on_step):
        done.append(cell.seed)
        if cell.seed == 1:
            raise RefusedError("an attack would prove nothing")
        finish(cell, folder)

    found = sweep(cells, tmp_path, task)
    assert done == [0, 1, 2, 3] and list(found.errors) == [1]
    assert table(tmp_path)[1]["error"] == "an attack would prove nothing"


def test_a_refusal_stays_one_from_process_to_process():
    told = _failed(RefusedError("no"))
    assert isinstance(failure(0, told), RefusedError)
    assert not isinstance(failure(0, _failed(InputError("no"))), RefusedError)


def test_complete_cells_outlive_an_interruption(cells, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        sweep(cells, tmp_path, Tasks({2: -1}))
    assert [row["seed"] for row in table(tmp_path)] == [0, 1]
    (tmp_path / "results.parquet").unlink()  # it is made of the cells
    rest = Tasks()
    found = sweep(cells, tmp_path, rest)
    assert rest.done == [2, 3] and found.kept == 2
    assert [row["seed"] for row in table(tmp_path)] == [0, 1, 2, 3]


def test_cells_of_another_grid_are_not_in_the_table(cells, tmp_path):
    sweep(cells[:2], tmp_path, Tasks())
    found = Tasks()
    sweep(cells[1:3], tmp_path, found)
    assert found.done == [2]
    assert [row["seed"] for row in table(tmp_path)] == [1, 2]


def test_a_cell_whose_files_are_on_another_disk_has_failed(cells, tmp_path):
    found = sweep(cells[:1], tmp_path, lambda cell, folder, on_step: None)
    assert "must be on a disk that all machines share" in found.errors[0]


def test_a_real_cell_goes_on_where_it_was(cells, tmp_path, no_results):
    """The run folder is that of an attack, whose checkpoint is taken up."""
    cell, steps = cells[0], []

    def stop():
        steps.append(0)
        if len(steps) == 70:  # among the iterations
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cell(cell, tmp_path, stop)
    folder = folder_of(tmp_path, cell)
    assert (folder / "checkpoint.safetensors").exists()
    assert not is_complete(tmp_path, cell)
    before = len(steps)
    run_cell(cell, tmp_path, lambda: steps.append(0))
    assert is_complete(tmp_path, cell)
    about = files.read_json(folder / "cell.json")
    assert about["digests"] == cell.digests and "mitsuba" in about["versions"]
    done = len(steps)
    run_cell(cell, tmp_path, lambda: steps.append(0))
    assert len(steps) == done > before


def test_a_cell_is_refused_where_its_files_are_others(cells, tmp_path, scenario_folder):
    route = scenario_folder / "routes.json"
    text = route.read_text()
    route.write_text(text + "\n")
    try:
        with pytest.raises(InputError, match="scenario, scene.routes: other"):
            run_cell(cells[0], tmp_path, lambda: None)
    finally:
        route.write_text(text)
    assert not folder_of(tmp_path, cells[0]).exists()
