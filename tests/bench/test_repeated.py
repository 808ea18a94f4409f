"""Rows of the studies made again: in which folder, and after which failure."""

from __future__ import annotations

import json
import sys

import pytest

from bench.__main__ import main
from bench.results import run_for_output
from bench.studies import plan, run
from bench.studies.plan import Study
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.table import read_made, write_table
from mi_nerfattack.io import files

GRID = 'scenario = "bundled:base.toml"\nseeds = [0]\n'
CELL = "left-car-gradient-0"
ROW = {
    "cell": CELL,
    "route": "left",
    "objects": "car",
    "method": "gradient",
    "seed": 0,
    "environment": "surrogate",
    "case": "attack",
    "run": 0,
    "frames": 9,
    "steps": 4,
    "cross_track_mean_m": 0.1,
    "wheel_out_s": 0.0,
    "departed": False,
    "status": "complete",
}


def document(error: float, failure: str | None = None) -> str:
    """Return what ``reproduce --json`` prints of one cell."""
    cell = {"cell": CELL, "rows": 1, "unmatched": 0, "error": failure}
    cell["largest_difference"] = {"cross_track_mean_m": error}
    cell["versions"] = {"source": ["then", "today"]}
    return json.dumps({"cells": [cell]})


def write(folder, scenario=""):
    cell = {"digests": {}, "versions": None, "scenario": scenario}
    write_table(files.make_folder(folder), [ROW], {CELL: cell})


@pytest.fixture
def studies(tmp_path, monkeypatch):
    """Return two studies with a committed row each, in the test's folder."""
    monkeypatch.setattr(plan, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(run, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(run, "ROOT", tmp_path)
    grid = tmp_path / "grid.toml"
    grid.write_text(GRID)
    words = {"question": "?", "basis": "none", "core_hours": 1.0, "grid": str(grid)}
    chosen = []
    for name in ("first", "second"):
        folder = tmp_path / "tables" / name
        write(folder)
        values = words | {"name": name, "table": str(folder)}
        chosen.append(Study.model_validate(values))
    monkeypatch.setattr(run, "choose", lambda names: chosen)
    return chosen


def test_another_program_or_draw_makes_the_rows_in_another_folder(studies, monkeypatch):
    """A sweep takes the complete cells of its folder, whoever made them."""
    commands = []
    monkeypatch.setattr(run, "run_command", commands.append)
    monkeypatch.setattr(run, "write_pages", lambda *args: [])

    def reproduce(words):
        commands.append(words)
        return 0, document(0.0)

    monkeypatch.setattr(run, "run_for_output", reproduce)
    places = []
    for source in ("old", "old", "new"):
        monkeypatch.setattr(run, "versions", lambda source=source: {"source": source})
        commands.clear()
        assert main(["results", "--check"]) == 0
        with pytest.raises(InputError):  # the stand-in makes no table
            run.BenchResults()._quick(studies[0])
        places.append([words[words.index("-o") + 1] for words in commands])
        assert len(set(places[-1])) == len(commands) == 3
    assert places[0] == places[1] and not {*places[0]} & {*places[2]}
    assert run._fresh_name("check", "a") != run._fresh_name("check", "b")


def test_a_study_that_fails_does_not_end_the_check(studies, monkeypatch, capsys):
    """Without a document there is a reason; with one, the failed cells are named."""
    answers = [(2, ""), (1, document(0.5, "no room"))]
    monkeypatch.setattr(run, "run_for_output", lambda words: answers.pop(0))
    assert main(["results", "--check", "--json"]) == 1
    rows = json.loads(capsys.readouterr().out)
    first, second = (rows[study.name] for study in studies)
    assert "ended with 2" in first["error"] and first["largest_m"] is None
    assert second["error"] is None and second["failed"] == [CELL]
    assert not (studies[0].folder / "check.json").exists()
    stored = files.read_json(studies[1].folder / "check.json")
    assert stored["changed_versions"] == {CELL: {"source": ["then", "today"]}}
    assert stored["program"]["source"] and stored["largest_m"] == 0.5


def test_the_output_of_a_command_that_fails_is_returned():
    code, text = run_for_output(["reproduce", "no-such-folder", "0", "--json"])
    assert code == 2 and text == ""


def test_a_script_runs_with_this_python():
    code, text = run_for_output(["python", "-c", "import sys; print(sys.executable)"])
    assert (code, text.strip()) == (0, sys.executable)


def test_a_check_makes_missing_inputs_first(studies, tmp_path, monkeypatch, capsys):
    commands = []

    def bake(words):
        commands.append(words)
        raise SystemExit(3)

    item = plan.Input(file="build/bricks", command="bake base -o build/bricks")
    monkeypatch.setattr(
        run, "read_plan", lambda: plan.Plan(inputs=(item,), studies=(studies[0],))
    )
    needs = studies[0].model_copy(update={"inputs": (item.file,)})
    monkeypatch.setattr(run, "choose", lambda names: [needs])
    monkeypatch.setattr(run, "run_command", bake)
    monkeypatch.setattr(run, "run_for_output", lambda words: (0, document(0.0)))
    assert main(["results", "--check", "--json"]) == 1
    error = json.loads(capsys.readouterr().out)["first"]["error"]
    assert commands == [["bake", "base", "-o", "build/bricks"]]
    assert item.file in error and "ended with 3" in error
    files.make_folder(tmp_path / "build")
    (tmp_path / item.file).write_text("bricks")
    assert main(["results", "--check", "--json"]) == 0 and len(commands) == 1


def test_the_committed_cells_have_no_path_of_this_machine(studies, tmp_path):
    """Of a table in ROOT/tables/first, ROOT is the folder .. of its parent."""
    study = studies[0]
    write(study.work, f'[scene]\nbricks = "{tmp_path}/build/b.safetensors"\n')
    run.refresh(study)
    text = read_made(study.folder)[CELL]["scenario"]
    assert text == '[scene]\nbricks = "../build/b.safetensors"\n'


def test_commands_of_a_study_get_the_folder_of_data(monkeypatch, capsys):
    study = plan.Study(
        name="photographs",
        question="?",
        table="none",
        commands=("bench poses {data}/fox -o {work}/poses",),
        cells=1,
        core_hours=1,
        basis="none",
    )
    commands = []
    monkeypatch.setattr(run, "run_command", commands.append)
    monkeypatch.setattr(run, "choose", lambda names: [study])
    monkeypatch.setattr(run, "write_pages", lambda: [])
    monkeypatch.delenv("NERFATTACK_DATA", raising=False)
    assert main(["results", "--only", "photographs"]) == 1
    assert "NERFATTACK_DATA: set it" in capsys.readouterr().out
    monkeypatch.setenv("NERFATTACK_DATA", "/two words")
    assert main(["results", "--only", "photographs"]) == 0
    words = "bench", "poses", "/two words/fox", "-o", f"{study.work}/poses"
    assert commands == [list(words)]
