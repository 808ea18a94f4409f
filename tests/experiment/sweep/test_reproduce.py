"""Rows that are repeated, and by how much they are said to differ."""

from __future__ import annotations

import json
import shutil
import signal
import tempfile
from pathlib import Path

import pandas as pd
import pytest
from support.faults.injected import signalled
from support.pages.read import PageReader

from mi_nerfattack import cli
from mi_nerfattack.commands.reproduce import Reproduce
from mi_nerfattack.drives.table import records
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.page import sweep as page_sweep
from mi_nerfattack.experiment.page.write import read_folders
from mi_nerfattack.experiment.sweep.cell import changed, folder_of
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.experiment.sweep.reproduce import (
    compare_rows,
    read_replay,
    sentences,
)
from mi_nerfattack.experiment.sweep.summary import summarise
from mi_nerfattack.experiment.sweep.sweep import Cells, Sweep
from mi_nerfattack.experiment.sweep.table import read_made, read_table, write_table
from mi_nerfattack.io import files
from mi_nerfattack.system import workers
from mi_nerfattack.system.workers import InThisProcess

pytestmark = pytest.mark.usefixtures("variant")

GRID = """\
scenario = "scenario.toml"
[[methods]]
name = "gradient"
set.attack.deterministic = true
set.attack.method.max_iterations = 2
set.baseline.textures = 2
"""
ROUNDED = 0.125


@pytest.fixture(scope="module")
def swept(scenario_folder, tmp_path_factory):
    """A sweep of one cell, and a copy of its table alone, of which a row is wrong."""
    grid = scenario_folder / "replay.toml"
    grid.write_text(GRID)
    folder, copy = (tmp_path_factory.mktemp(name) for name in ("sweep", "copy"))
    [cell] = cells = load_cells(grid)
    sweep = Sweep(Cells(tuple(cells), folder))
    sweep.run(InThisProcess())
    assert not sweep.errors
    rows = records(read_table(sweep.table))
    rows[-1]["cross_track_mean_m"] += ROUNDED
    rows.append({"status": "failed", "error": "no room", "cell": "other"})
    made = read_made(folder)
    made[cell.id]["versions"]["torch"] = "1"
    made["other"] = made[cell.id] | {"versions": None}
    write_table(copy, rows, made)
    return folder, copy, cell


@pytest.fixture
def command(monkeypatch, capsys):
    """Return what runs the command in this process: exit code, output."""
    monkeypatch.setattr(workers, "Processes", lambda *_, **__: InThisProcess())

    def run(*words):
        code = cli.main(["reproduce", *map(str, words)])
        return code, capsys.readouterr().out

    return run


def test_rows_come_back_to_the_bit(swept, command, tmp_path):
    """Of the table alone; all but the row that was made wrong."""
    _, copy, cell = swept
    last = len(read_table(copy / "results.csv")) - 2
    words = copy, last, f"{cell.id}:surrogate:own:0", "--json", "-o", tmp_path / "out"
    code, out = command(*words)
    document = json.loads(out)
    assert code == 0
    wrong, right = document["rows"]
    assert (wrong["row"], wrong["case"], right["case"]) == (last, "attack", "own")
    assert set(right["difference"].values()) == {0}
    assert right["stored"] == right["repeated"]
    assert wrong["difference"].pop("cross_track_mean_m") == pytest.approx(ROUNDED)
    assert set(wrong["difference"].values()) == {0}
    [entry] = document["cells"]
    assert (entry["cell"], entry["rows"], entry["unmatched"]) == (cell.id, last + 1, 0)
    assert entry["largest_difference"]["cross_track_mean_m"] == pytest.approx(ROUNDED)
    assert entry["largest_difference"]["frames"] == 0
    code, out = command(*words[:2], *words[4:], "--tolerance", 0.1)
    assert code == 1 and f"(0.125){chr(10)}" in out  # it is not done again
    code, out = command(*words[:1], *words[2:3], *words[4:], "--tolerance", 0)
    assert code == 0 and "m, all equal\n" in out


def test_environments_of_an_older_table_get_their_names_of_today(swept, tmp_path):
    copy = shutil.copytree(swept[1], tmp_path / "copy")
    path, today = copy / "results.csv", read_table(copy / "results.csv")
    assert set(today["environment"].dropna()) == {"surrogate", "mitsuba"}
    path.write_text(path.read_text().replace(",mitsuba,", ",deployment,"))
    pd.testing.assert_frame_equal(read_table(path), today)


def test_drives_alone_come_back(swept, command, tmp_path):
    folder, _, cell = swept
    out = tmp_path / "out"
    folder_of(out, cell).mkdir(parents=True)  # killed before the checkpoint was there
    code, printed = command(folder, "--rows", 3, "--drives-only", "--json", "-o", out)
    document = json.loads(printed)
    assert code == 0 and len(document["rows"]) == 3
    assert set(document["largest_difference"].values()) == {0}
    cost = files.read_json(folder_of(out, cell) / "metrics.json")["cost"]
    assert cost["processes"] == 2  # the attack's, and this one


def test_an_interrupted_replay_leaves_nothing(swept, command, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with signalled("cells", signal.SIGTERM, at=12):
        assert command(swept[0], 0)[0] == 130
    assert not list(tmp_path.iterdir())


def test_the_sweep_on_one_page(swept, tmp_path):
    """Its cells give pictures; of a table alone there is what its rows tell."""
    folder, copy, cell = swept
    page = tmp_path / "page.html"
    assert cli.main(["report", str(folder), str(copy), "-o", str(page)]) == 0
    reader = PageReader(files.read_text(page))
    reader.check_alone()
    table = read_table(folder / "results.csv")
    [attack] = [
        group
        for group in summarise(table)["groups"]
        if group["route"]
        and (group["environment"], group["case"]) == ("mitsuba", "attack")
    ]
    n, mean = str(attack["attacks"]), f"{attack['cross_track_mean_m']:.3f}"
    assert ["", "", "", "attack", n, mean, "–", "–"] in [r[:8] for r in reader.rows]
    shown = [image["alt"] for image in reader.images]
    assert "First drives of all attacks: line, gradient, n = 1" in shown
    assert any("as the attack left it" in alt for alt in shown)
    name = f"{cell.id}:surrogate:attack:0"
    assert f"mi-nerfattack reproduce {folder} {name}" in reader.text
    assert "failed: no room" in reader.text and str(copy / "cells") in reader.text


def test_sweeps_of_one_name_on_a_page(swept, tmp_path, monkeypatch):
    """Each has plots of its own; a failed cell has none, whatever it left."""
    folder, _, cell = swept
    monkeypatch.setattr(page_sweep, "_shown", lambda *_: [])  # no turning objects
    paths = [shutil.copytree(folder, tmp_path / name / "sweep") for name in "abc"]
    failed = {"status": "failed", "error": "no room", "cell": cell.id}
    write_table(paths[2], [failed], {})
    one, two, three = read_folders(paths, tmp_path).sweeps
    assert len({*one.pictures.values(), *two.pictures.values()}) == 2
    assert not three.pictures and three.notes


def test_what_differs_is_told(swept):
    """Versions, drives that there are none of, failures; made by hand."""
    folder, copy, cell = swept
    replay = read_replay(copy, ["0"])
    rows, made = read_table(folder / "results.csv"), read_made(folder)
    document = compare_rows(replay, rows[2:], made, {})
    [row], [entry] = document["rows"], document["cells"]
    assert row["repeated"] is None and document["largest_difference"] is None
    assert (entry["rows"], entry["unmatched"]) == (len(rows) - 2, 2)
    other = {cell.id: {"versions": {"numpy": "0"}}}
    lines = sentences(compare_rows(replay, rows, other, {}))
    assert any(line.endswith("then, 0 here") for line in lines)
    failed = compare_rows(replay, rows[:0], {}, {cell.id: "a mistake\nno room"})
    assert sentences(failed)[-1].endswith(f"{cell.id}: no room")


def test_rows_that_cannot_be_repeated(swept, command, tmp_path):
    folder, copy, cell = swept
    for names, count, message in (
        (["99"], 0, "row 99; .* 0 to"),
        ([f"{cell.id}:moon:own:0"], 0, ":no_object:0"),
        ([str(len(read_table(copy / "results.csv")) - 1)], 0, "no room"),
        ([], 99, "99"),
    ):
        with pytest.raises(InputError, match=message):
            read_replay(copy, names, count)
    for words in ((copy,), (folder, 0, "-o", folder), (copy, 0, "--drives-only")):
        assert command(*words, *(["-o", tmp_path] if "-o" not in words else []))[0] == 2
    with pytest.raises(InputError, match="other cells, .*other"):
        Reproduce(folder, ("0",), output=copy).run()
    made = read_made(copy)
    made[cell.id]["digests"]["scene.routes"] = "0"
    shutil.copy(copy / "results.csv", tmp_path)
    files.write_json(tmp_path / "cells.json", made)
    with pytest.raises(InputError, match="scene.routes: other content"):
        read_replay(tmp_path, ["0"])


def test_relative_paths_of_a_cell_begin_in_the_parent_of_the_table(
    swept, scenario_folder, tmp_path, monkeypatch
):
    """Of a committed table; the current folder does not count."""
    _, copy, cell = swept
    inputs = shutil.copytree(scenario_folder, tmp_path / "inputs")
    table = shutil.copytree(copy, tmp_path / "bench" / "table")
    made = read_made(table)
    text = made[cell.id]["scenario"]
    assert str(scenario_folder) in text
    relative = text.replace(str(scenario_folder), "../inputs")
    made[cell.id] |= {"scenario": relative}
    files.write_json(table / "cells.json", made)
    monkeypatch.chdir(table.parents[1])
    [replayed] = read_replay(Path("bench/table"), ["0"]).cells
    assert not changed(replayed) and "../" not in replayed.text
    assert replayed.scenario.objects[0].field.path == inputs / "object.safetensors"


def test_a_row_without_its_cell_is_refused(swept, tmp_path):
    copy = shutil.copytree(swept[1], tmp_path / "copy")
    path = copy / "results.csv"
    files.write_json(copy / "cells.json", {})
    with pytest.raises(InputError, match=swept[2].id):
        read_replay(copy, ["0"])
    path.write_text(path.read_text().replace(",mitsuba,", ",deployment,"))
    with pytest.raises(InputError, match=rf"cells\.json: .*{swept[2].id}.*; copy"):
        read_table(path)


def test_a_row_of_the_first_form_is_read():
    """Its cell keeps its name, though the scenario's digest is made of other keys."""
    replay = read_replay(Path(__file__).parents[3] / "docs/results/table2", ["0"])
    [cell] = replay.cells
    assert cell.id == replay.table["cell"][0] and not changed(cell)
    assert cell.scenario.attack.method.iterations(1) == 24
