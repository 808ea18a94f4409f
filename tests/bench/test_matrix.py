"""The best attacks everywhere: which are chosen, what is driven, what the page says."""

from __future__ import annotations

import json

import pytest

from bench.__main__ import main
from bench.matrix import best_attacks
from mi_nerfattack import cli
from mi_nerfattack.experiment.sweep.table import write_table
from mi_nerfattack.io import files

COUNTS = {"attacks": 2, "attacks_out": 1, "attacks_out_rate_ci95": [0.0945, 0.9055]}


def row(cell, method, seed, error, case="attack", route="right"):
    labels = {"cell": cell, "method": method, "seed": seed, "route": route}
    labels |= {"environment": "surrogate", "case": case, "status": "complete"}
    return labels | {"cross_track_mean_m": error}


def rows():
    """Return two drives an attack: a at 0.3, b at 0.5, c at 0.2, and a look at 9."""
    found = [row("a", "gradient", 1, error) for error in (0.1, 0.5)]
    found += [row("b", "gradient", 2, error) for error in (0.4, 0.6)]
    found += [row("c", "random", 1, error) for error in (0.2, 0.2)]
    return [*found, row("c", "random", 1, 9.0, case="random")]


def test_the_best_of_a_method_at_a_place_stands_for_it(tmp_path):
    """Another sweep's gradient at the first place is better than a, and replaces it."""
    other = [row("d", "gradient", 1, 0.4)]
    sweeps = [(tmp_path / "one", rows()), (tmp_path / "two", other)]
    names = [path.relative_to(tmp_path) for path in best_attacks(sweeps, 3)]
    assert [str(n) for n in names] == ["one/cells/b", "two/cells/d", "one/cells/c"]
    assert best_attacks(sweeps, 1) == [tmp_path / "one" / "cells" / "b"]
    with pytest.raises(Exception, match="right: 3 attacks, not 4"):
        best_attacks(sweeps, 4)


def document(labels):
    """Return a transfer of two attacks, of which one is out by day and none at noon."""
    columns, found = [], []
    for condition, ratio, errors in (
        ("day", 1.0, (0.6, 0.2)),
        ("noon", 0.5, (0.3, 0.1)),
    ):
        for label, error in zip(labels, errors, strict=True):
            about = {"attack": label, "environment": "mitsuba", "condition": condition}
            figures = {"cross_track_mean_m": error, "cross_track_max_m": 1.0}
            figures |= {"wheel_out_s": 0.0, "drives_departed": 0}
            cases = {"no_object": figures, "attack": figures}
            found.append(about | {"cases": cases, "succeeds": error > 0.5})
        over = {"cross_track_mean_m": sum(errors) / 2, "cross_track_sd_m": 0.1}
        over |= {"cross_track_mean_ci95_m": errors[::-1]} | COUNTS
        transfer = {"kept": int(condition == "day"), "of": 1, "rate_ci95": [0.2, 1.0]}
        about = {"environment": "mitsuba", "condition": condition}
        about |= {"cases": {"no_object": over, "attack": over}, "transfer": transfer}
        columns.append(about | {"ratio_to_surrogate": ratio})
    attacks = [{"label": label, "route": "right"} for label in labels]
    return {"attacks": attacks, "rows": found, "columns": columns, "starts": 1}


def test_the_command_chooses_drives_and_writes(tmp_path, monkeypatch, capsys):
    parquet = pytest.importorskip("pyarrow.parquet")
    sweep, folder, output = tmp_path / "sweep", tmp_path / "drives", tmp_path / "page"
    files.make_folder(sweep)
    many = [row(f"c{seed}", "gradient", seed, seed / 10) for seed in range(9)]
    write_table(sweep / "results.parquet", many)
    given, remade = [], folder / "remade" / "0" / "cells"

    def run(words):
        given.append(words)
        if words[0] == "replay":
            for name in words[2:10]:
                path = remade / name.partition(":")[0]
                files.make_folder(path)
                (path / "metrics.json").touch()
            return
        labels = [words[1].rpartition("/")[2], words[2].rpartition("/")[2]]
        files.make_folder(folder)
        (folder / "transfer.json").write_text(json.dumps(document(labels)))

    monkeypatch.setattr("bench.commands.quality.run_command", run)
    assert main(["matrix", str(folder), str(sweep), "-o", str(output)]) == 0
    again, first, second = given
    assert again[1] == str(sweep) and again[-2:] == ["-o", str(remade.parent)]
    assert again[2:10] == [f"c{8 - k}:surrogate:attack:0" for k in range(8)]
    assert second[: len(first)] == first
    assert first[1:9] == [str(remade / f"c{8 - k}") for k in range(8)]
    assert "mujoco_gl_built_in" in second and "--environments" not in first
    text = (output / "README.md").read_text()
    assert "The 2 best attacks" in text
    day = "| day | 0.400 | 0.400 ± 0.100 [0.200, 0.600] (2); 1/2 out [9, 91] | 1.00 "
    assert day + "| 1/1 [20, 100] |" in text
    assert "| c8 | **0.600** |" in text and "| c7 | 0.200 |" in text
    table = parquet.read_table(output / "drives.parquet").to_pylist()
    assert len(table) == 8 and table[0]["case"] == "no_object"
    given.clear()
    assert main(["matrix", str(folder), str(sweep), "-o", str(output)]) == 0
    assert [words[0] for words in given] == ["transfer", "transfer"]
    few = ["matrix", str(folder), str(tmp_path / "none")]
    assert main(few) == cli.EXIT_INPUT and "results.parquet" in capsys.readouterr().err
