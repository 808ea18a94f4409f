"""Cells that were done elsewhere, of which there are a table and a summary."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.cell import folder_of
from mi_nerfattack.experiment.sweep.summary import write_summary
from mi_nerfattack.experiment.sweep.sweep import Cells, Sweep
from mi_nerfattack.experiment.sweep.table import read_table
from mi_nerfattack.experiment.sweep.taken import Taken, read_taken
from mi_nerfattack.io import files
from mi_nerfattack.system.workers import InThisProcess
from tests.experiment.sweep.conftest import finish

pytest.importorskip(
    "pyarrow", reason="needs the extra 'sweep': pyarrow writes the table"
)
pytestmark = pytest.mark.usefixtures("variant")


NOTHING = Taken()


def sweep(cells, folder, taken=NOTHING):
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
    sweep(cells, folder)
    shutil.rmtree(folder / "cells")
    return folder


def test_complete_cells_are_not_done_again(cells, elsewhere, tmp_path):
    whole, again = tmp_path / "whole", tmp_path / "again"
    other = replace(cells[2], digests={"scenario": "0123456789abcdef"})
    changed = [*cells[:2], other, cells[3]]
    done, summary = sweep(changed, again, read_taken([elsewhere]))
    assert done == [2, 3]  # another cell, and the one that had failed
    assert not folder_of(again, cells[0]).exists()
    _, alone = sweep(changed, whole, Taken(rows={"none": []}))
    assert summary == alone and len(summary["attacks"]) == 4
    assert read_table(again / "results.parquet") == read_table(
        whole / "results.parquet"
    )
    scenario = ["cell", "scenario"]
    texts = read_table(again / "results.parquet", scenario)
    assert [row["scenario"] for row in texts] == [cell.text for cell in changed]
    # what was taken stays told where the folder's own summary is all that there is
    assert write_summary(again) == summary


def test_the_first_folder_that_has_a_cell_counts(cells, elsewhere, tmp_path):
    second = tmp_path / "second"
    _, summary = sweep(cells, second, Taken(rows={"none": []}))
    taken = read_taken([elsewhere, second])
    assert taken.rows.keys() == {cell.id for cell in cells}
    assert taken.attacks.keys() == {one["cell"] for one in summary["attacks"]}
    (elsewhere / "summary.json").unlink()
    assert read_taken([elsewhere]).attacks == {}


def test_what_cannot_be_taken_is_told(elsewhere, tmp_path):
    with pytest.raises(InputError, match=r"nowhere.results\.parquet"):
        read_taken([tmp_path / "nowhere"])
    files.write_json(elsewhere / "summary.json", {"schema": 0})
    with pytest.raises(InputError, match=r"summary\.json: no summary .* schema 1"):
        read_taken([elsewhere])
