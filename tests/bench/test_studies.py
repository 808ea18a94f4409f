"""The studies of bench/results.toml: plan, state, runs and checks."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest
from support.pages.studies import table

from bench.__main__ import main
from bench.studies import plan, run
from bench.studies.findings import finding
from bench.studies.plan import ROOT, Study, read_plan, state
from mi_nerfattack import cli
from mi_nerfattack.experiment.sweep.table import COLUMNS, write_table
from mi_nerfattack.io import files

STUDIES = {study.name: study for study in read_plan().studies}
GRID = """
scenario = "bundled:base.toml"
seeds = [1, 2]
routes = [{ name = "a", set.scene.route = "left" }, { name = "b" }]
methods = [{ name = "one" }, { name = "two", set.attack.method.max_iterations = 3 }]
objects = [{ name = "near", routes = ["b"] }, { name = "far" }]
"""


@pytest.mark.parametrize("study", STUDIES.values(), ids=list(STUDIES))
def test_studies_name_files_that_exist(study):
    for path in filter(None, (study.grid, *study.pages)):
        assert (ROOT / path).exists()
    known = {item.file for item in read_plan().inputs}
    assert set(study.inputs) <= known
    one = state(study, compare=False)
    assert 0 <= one.done <= one.wanted > 0
    assert one.hours_left == pytest.approx((one.wanted - one.done) * study.core_hours)


def test_a_check_draws_whole_cells_until_a_tenth_of_the_rows():
    rows = pd.concat(table({"attack": [0.1] * 20, "own": [0.1] * 20}) for _ in range(2))
    drawn = run.drawn_rows(rows, 0.1, 3)  # 8 of 80 rows, 4 per cell
    assert len(set(drawn)) == 2 and drawn == run.drawn_rows(rows, 0.1, 3)
    assert drawn != run.drawn_rows(rows, 0.1, 4)
    assert len(run.drawn_rows(rows, 1.0, 0)) == 20


@pytest.fixture
def study(tmp_path, monkeypatch):
    """Return a study whose runs and table are in the test's folder."""
    (tmp_path / "grid.toml").write_text(GRID)
    monkeypatch.setattr(plan, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(run, "RUNS", tmp_path / "runs")
    words = {"name": "one", "question": "?", "basis": "none", "core_hours": 1.0}
    paths = {"table": str(tmp_path / "table"), "grid": str(tmp_path / "grid.toml")}
    made = Study.model_validate(words | paths)
    monkeypatch.setattr(run, "choose", lambda names: [made])
    monkeypatch.setattr(run, "write_pages", lambda *args: [])
    return made


def write(folder, rows):
    plain = rows[list(COLUMNS)].astype(object)
    records = plain.where(plain.notna(), None).to_dict("records")
    cell = {"digests": {}, "versions": None, "scenario": ""}
    write_table(files.make_folder(folder), records, dict.fromkeys(rows["cell"], cell))


def test_a_title_claims_nothing_while_attacks_are_missing(study):
    labels = {"route": "a", "objects": "far", "method": "one"}
    write(study.folder, table({"attack": [0.1] * 3}, **labels))  # seeds 0, 1, 2
    answer = finding(study.model_copy(update={"finding": "searches"}))
    assert answer.title.endswith("best: 2 of 12 attacks exist")


def test_a_table_is_never_replaced_by_one_with_fewer_attacks(study, capsys):
    for count, stored in ((2, 2), (1, 2), (3, 3)):
        write(study.work, table({"attack": [0.1 * count] * count}))
        run.refresh(study)
        assert len(study.read()) == stored
    assert "1 cells" in capsys.readouterr().out
    document = json.loads((study.folder / "summary.json").read_text())
    assert document["complete"] == 3


def test_a_run_takes_the_committed_rows_and_goes_on_after_a_failure(study, monkeypatch):
    calls = []

    def fail(words):
        calls.append(words)
        raise SystemExit(1)

    monkeypatch.setattr(run, "run_command", fail)
    assert main(["results", "--workers", "1"]) == 1
    write(study.folder, table({"attack": [0.1]}))
    assert main(["results"]) == 1
    reported = study.model_copy(update={"report": "report {work} -o page.md"})
    monkeypatch.setattr(run, "choose", lambda names: [reported])
    assert main(["results"]) == 1  # no report after a failure
    monkeypatch.setattr(run, "run_command", calls.append)
    assert main(["results"]) == 0
    sweep = ["sweep", study.grid, "-o", str(study.work)]
    assert calls == [
        [*sweep, "--workers", "1"],
        *3 * [[*sweep, "--take", str(study.folder)]],
        ["report", str(study.work), "-o", "page.md"],
    ]


def test_commands_find_the_folder_that_they_write_in(study, monkeypatch):
    other = {"grid": None, "cells": 1, "commands": ("fit x -o {work}/field",)}
    fits = study.model_copy(update=other)
    monkeypatch.setattr(run, "choose", lambda names: [fits])
    calls = []

    def write_field(words):
        calls.append(words)
        Path(words[-1]).write_text("")

    monkeypatch.setattr(run, "run_command", write_field)
    assert main(["results"]) == 0
    assert calls == [["fit", "x", "-o", str(study.work / "field")]]


def test_a_check_writes_the_differences_next_to_the_table(study, monkeypatch, capsys):
    write(study.folder, table({"attack": [0.1] * 12}))
    largest = {"cross_track_mean_m": 0.25}
    cell = {"cell": "c", "rows": 2, "unmatched": 0, "error": None, "versions": {}}
    report = {"cells": [cell | {"largest_difference": largest}]}
    monkeypatch.setattr(run, "run_for_output", lambda words: (0, json.dumps(report)))
    assert main(["results", "--check", "--seed", "5", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    stored = json.loads((study.folder / "check.json").read_text())
    for row in (document["one"], stored):
        assert (row["largest_m"], row["rows"], row["of"], row["seed"]) == (
            0.25,
            2,
            12,
            5,
        )


def test_quick_compares_with_the_committed_rows(study, monkeypatch, capsys):
    write(study.folder, table({"attack": [0.1, 0.2]}))
    monkeypatch.setattr(run, "versions", dict)
    made = study.model_copy(update={"name": run._fresh_name(study.name)})
    write(made.work, table({"attack": [0.1, 0.5, 0.7]}))
    calls = []
    monkeypatch.setattr(run, "run_command", lambda words: calls.append(words))
    monkeypatch.setattr(run, "ROOT", study.work.parents[1])
    assert main(["results", "--quick", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert "--take" not in calls[0] and document["compared"] == 2
    assert document["largest_m"] == pytest.approx(0.3)


def test_the_state_is_listed_and_wrong_options_are_refused(capsys):
    names = ["reach", "photographs"]
    assert main(["results", "--list", "--only", *names, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["photographs"]["done"] == document["photographs"]["wanted"]
    reach = document["reach"]
    hours = (reach["wanted"] - reach["done"]) * STUDIES["reach"].core_hours
    assert document["hours_left"] == reach["hours_left"] == pytest.approx(hours)
    for words, where in ((["--only", "none"], "--only"), (["--list", "--check"], "--")):
        assert main(["results", *words]) == cli.EXIT_INPUT
        assert where in capsys.readouterr().err
