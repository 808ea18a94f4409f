"""Tables of drives and of their figures."""

from __future__ import annotations

import csv
import io

import rich.console
from helpers.made_drives import LANES, RUN_ENVIRONMENTS, make_drive

from mi_nerfattack.evaluation import metrics
from mi_nerfattack.io import files
from mi_nerfattack.report import table
from mi_nerfattack.rollout.drive import CASES, Lane


def test_steps_hold_a_row_per_step(tmp_path):
    drives = [make_drive([0.1, -0.9]), make_drive([1 / 3], case="attack")]
    table.write_steps(tmp_path / "steps.csv", drives, LANES)
    rows = list(csv.DictReader(io.StringIO(files.read_text(tmp_path / "steps.csv"))))
    assert tuple(rows[0]) == table.STEP_COLUMNS
    assert [row["step"] for row in rows] == ["1", "2", "1"]
    assert [row["departed"] for row in rows] == ["0", "1", "0"]
    assert float(rows[1]["x_m"]) == 1.0
    assert float(rows[1]["control"]) == 0.1
    assert float(rows[2]["cross_track_m"]) == 1 / 3
    assert rows[2]["case"] == "attack"


def test_metrics_table_fits_80_columns():
    drives = [
        make_drive([123.4, 0.1], environment, case, run, route="roundabout")
        for environment in RUN_ENVIRONMENTS
        for case in CASES
        for run in range(100)
    ]
    figures = metrics.summarise(drives, {"roundabout": Lane(0.85, 1.75)})
    console = rich.console.Console(width=80, file=io.StringIO(), color_system=None)
    console.print(table.metrics_table({"routes": figures}))
    text = console.file.getvalue()
    assert all(len(line) <= 80 for line in text.splitlines())
    assert text.count("own") == 2
    assert "61.750" in text
    assert "…" not in text
