"""Figures of sweeps and transfers in pages of Markdown."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.reference.derivatives import digits

from mi_nerfattack import cli
from mi_nerfattack.commands.transfer import Transfer
from mi_nerfattack.drives.table import read_csv
from mi_nerfattack.experiment.page import markdown
from mi_nerfattack.experiment.sweep.cell import changed
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.experiment.sweep.reproduce import read_replay
from mi_nerfattack.experiment.sweep.summary import SUMMARY, read_attacks, summarise
from mi_nerfattack.experiment.sweep.table import (
    RESULTS,
    read_made,
    read_table,
)
from mi_nerfattack.experiment.transfer.columns import ENVIRONMENTS, make_columns
from mi_nerfattack.experiment.transfer.figures import TABLE
from mi_nerfattack.io import files

ROOT = Path(__file__).parents[3]
SCENES, DOCS = ROOT / "scenes", ROOT / "docs"
TABLE2, METHODS = DOCS / "results/table2", DOCS / "results/methods"


def test_text_around_the_figures_stays(tmp_path):
    path = tmp_path / "README.md"
    assert cli.main(["report", str(TABLE2), "-o", str(path)]) == 0
    first = path.read_text()
    path.write_text(f"# Mine\n\n{markdown.BEGIN}\nold\n{markdown.END}\nEnd.\n")
    assert cli.main(["report", str(TABLE2), "-o", str(path)]) == 0
    figures = first.removeprefix("# Figures").removesuffix("\n")
    assert path.read_text() == f"# Mine{figures}\nEnd.\n"


def test_a_suffix_in_capitals_is_one_of_markdown(tmp_path):
    path = tmp_path / "PAGE.MD"
    assert cli.main(["report", str(TABLE2), "-o", str(path)]) == 0
    assert markdown.BEGIN in path.read_text()


def test_what_no_page_is_made_of_is_refused(tmp_path, capsys):
    marked, bare = tmp_path / "marked.md", tmp_path / "bare.md"
    bare.write_text("# Mine\n")
    other, unfinished = tmp_path / "other", tmp_path / "unfinished"
    for folder, content in (
        (other, {}),
        (unfinished, {"schema": 1, "complete": False}),
    ):
        folder.mkdir()
        files.write_json(folder / "transfer.json", content)
    rows = (
        ([other], marked, "is not of 'mi-nerfattack transfer'"),
        ([unfinished], marked, "rows are missing"),
        ([tmp_path], marked, "neither results.csv of a sweep nor transfer.json"),
        ([TABLE2], bare, f"{bare}: has no lines"),
        ([TABLE2, METHODS], marked, "pages of Markdown are of one each"),
        ([TABLE2], tmp_path / "a.html", "--tuning: is for pages of Markdown"),
        ([TABLE2], tmp_path / "a.txt", ".html or .htm or .md"),
    )
    for folders, path, message in rows:
        words = ["report", *map(str, folders), "-o", str(path)]
        words += ["--tuning", str(METHODS)] if path.suffix == ".html" else []
        assert cli.main(words) == cli.EXIT_INPUT
        assert message in " ".join(capsys.readouterr().err.split())


def document(name):
    """Return what a transfer of an attack writes, with 0.4 m everywhere."""
    run = {"run": 0, "cross_track_mean_m": 0.4, "cross_track_max_m": 1.0}
    figures = {"per_run": [run | {"wheel_out_s": 2.0, "steps_departed": 20}]}
    cases = {"no_object": figures, "attack": figures}
    rows = [
        {"attack": name, "environment": c.environment, "condition": c.condition.label}
        for c in make_columns(ENVIRONMENTS, Transfer.conditions, 1)
    ]
    attack = {"label": name, "route": "right", "found_sha256": "found"}
    rows = [row | {"cases": cases} for row in rows]
    return {"schema": 1, "complete": True, "attacks": [attack], "rows": rows}


def test_a_transfer_leaves_a_table_of_which_its_page_is_written_again(tmp_path):
    files.write_json(tmp_path / "transfer.json", document("b"))
    page = tmp_path / "page" / "README.md"
    page.parent.mkdir()
    assert cli.main(["report", str(tmp_path), "-o", str(page)]) == 0
    table = read_csv(page.with_name(markdown.DRIVES), TABLE)
    assert len(table) == 99 * 2 and set(table["cross_track_mean_m"]) == {0.4}
    text = page.read_text()
    assert cli.main(["report", str(page.parent), "-o", str(page)]) == 0
    assert page.read_text() == text


@pytest.mark.parametrize("left", ["no_object", "attack"])
def test_a_case_that_is_not_driven_leaves_its_cells_empty(left, tmp_path):
    transfer = document("b")
    for row in transfer["rows"]:
        row["cases"] = {k: v for k, v in row["cases"].items() if k != left}
    files.write_json(tmp_path / "transfer.json", transfer)
    page = tmp_path / "README.md"
    assert cli.main(["report", str(tmp_path), "-o", str(page)]) == 0
    cells = "|  | 0.400 | 1 of 1 |" if left == "no_object" else "| 0.400 |  |  |"
    assert f"| day {cells}" in page.read_text()


def group(method, budget, error, **others):
    """Return a group of a summary, of an attack on a right turn."""
    labels = {"route": "right", "method": method, "budget": budget}
    labels |= {"environment": "surrogate", "case": "attack", "frames": budget or 9.0}
    figures = {"cross_track_mean_m": error, "cross_track_mean_ci95_m": None}
    return labels | figures | {"attacks_out": 0, "attacks": 1} | others


def test_each_budget_has_its_row():
    summary = {
        "groups": [group("gradient", b, e) for b, e in ((1000, 0.2), (6000, 0.9))],
        "comparisons": [],
    }
    table = list(markdown._rows(summary, "surrogate", compared=False))
    assert [row[2] for row in table] == ["1000", "6000"]
    assert all(
        error in row for error, row in zip(("0.200", "0.900"), table, strict=True)
    )


def test_a_refusal_in_several_lines_is_one_row():
    failed = {"cell": "a", "error": "would prove nothing:\n  an | object\nmend it"}
    summary = {"complete": 0, "cells": 1, "flags": [], "failed": [failed]}
    *_, table = markdown._flags(summary)
    assert table.splitlines()[-1].endswith("nothing:   an \\| object mend it |")
    assert len(table.splitlines()) == 3


def test_a_setting_belongs_to_the_longest_name_of_a_method():
    names = "gradient_1", "gradient_2", "gradient_attached_0"
    pairs = zip(names, (0.2, 0.1, 0.9), strict=True)
    groups = [group(name, None, error) for name, error in pairs]
    text = markdown.settings({"groups": groups}, ["gradient", "gradient_attached"])
    rows = [line.split(" | ") for line in text.splitlines()[4:]]
    chosen = [row[1] for row in rows if "chosen" in row[-1]]
    assert len(rows) == 3 and chosen == ["gradient_1", "gradient_attached_0"]


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_budgets_have_the_attacks_of_table_2():
    cells = load_cells(SCENES / "budgets.toml")
    first = [cell for cell in cells if cell.method == "gradient"]
    assert [c.id for c in first] == [c.id for c in load_cells(SCENES / "table2.toml")]
    assert len(cells) == 3 * len(first)


def test_the_committed_rows_can_be_repeated():
    """A key that scenarios get later must leave their digests as they are."""
    made = read_made(TABLE2)
    drives = read_table(TABLE2 / RESULTS).drop_duplicates("cell")
    cells = read_replay(TABLE2, [str(index) for index in drives.index]).cells
    assert len(cells) == 15 and {cell.id for cell in cells} == made.keys()
    assert all(changed(cell) == [] for cell in cells)


@pytest.mark.parametrize("folder", [TABLE2, METHODS])
def test_the_committed_summary_is_that_of_the_committed_table(folder):
    drives = read_table(folder / RESULTS)
    summary = summarise(drives, read_attacks(folder, drives))
    assert digits(summary) == digits(files.read_json(folder / SUMMARY))


@pytest.mark.parametrize("folder", [TABLE2, METHODS, DOCS / "results/matrix"])
def test_the_committed_page_is_that_of_the_committed_table(folder, tmp_path):
    shutil.copy(folder / "README.md", tmp_path)
    words = ["report", str(folder), "-o", str(tmp_path / "README.md")]
    words += ["--tuning", str(METHODS / "tuning")] if folder == METHODS else []
    assert cli.main(words) == 0
    for path in tmp_path.rglob("*"):
        if path.is_file():
            own = folder / path.relative_to(tmp_path)
            if path.name != SUMMARY:  # floating point may differ in its last digit
                assert path.read_bytes() == own.read_bytes()
