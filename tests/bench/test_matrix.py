"""The best attacks everywhere: which are chosen, what is driven, what the page says."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from bench import matrix
from bench.__main__ import main
from bench.matrix import best_attacks
from mi_nerfattack import cli
from mi_nerfattack.commands.transfer import Transfer
from mi_nerfattack.experiment.sweep.table import write_table
from mi_nerfattack.experiment.transfer.columns import make_columns
from mi_nerfattack.io import files
from mi_nerfattack.report.plots import transfer as plots
from mi_nerfattack.report.plots.transfer import plot_transfer

FOUND = "mi_nerfattack.experiment.transfer.found"
ROW = "surrogate:attack:0"


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


def document(words):
    """Return what a transfer of such words writes; of two attacks c8 alone is out."""
    at = words.index("--environments"), words.index("--conditions")
    labels = [word.rpartition("/")[2] for word in words[1 : words.index("-o")]]
    environments, conditions = words[at[0] + 1 : at[1]], words[at[1] + 1 :]
    conditions = conditions[: conditions.index("--cases")]
    attacks = [
        {"label": name, "route": "right", "found_sha256": f"{name} found"}
        for name in labels
    ]
    rows = []
    for column in make_columns(environments, conditions, 1):
        for name in labels:
            error, out = (0.6, 2.0) if name == "c8" else (0.2, 0.0)
            if column.condition.label != "day":
                error, out = error / 2, 0.0
            figures = {"n": 1, "cross_track_mean_m": error, "cross_track_max_m": 1.0}
            figures |= {"wheel_out_s": out, "drives_departed": int(out > 1)}
            clean = figures | {"cross_track_mean_m": 0.1}
            about = {"attack": name, "environment": column.environment}
            about |= {"condition": column.condition.label}
            rows.append(about | {"cases": {"no_object": clean, "attack": figures}})
    return {"attacks": attacks, "rows": rows}


class Commands:
    """Stands for the commands: makes what they leave behind, and keeps their words."""

    def __init__(self, remade):
        self.given, self.remade = [], remade
        self.fails_at, self.rows_until = None, 0

    def __call__(self, words):
        self.given.append(words)
        if words[0] == "reproduce":
            for name in words[2 : words.index("-o")]:
                path = self.remade / name.partition(":")[0]
                files.make_folder(path)
                (path / "metrics.json").touch()
            return
        found = document(words)
        if fails := len(self.transfers()) == self.fails_at:
            found["rows"] = found["rows"][: self.rows_until]
        path = files.make_folder(Path(words[words.index("-o") + 1]))
        files.write_json(path / "transfer.json", found)
        if fails:
            raise SystemExit(1)

    def transfers(self):
        return [words for words in self.given if words[0] == "transfer"]


def found_of(folders):
    return [
        SimpleNamespace(label=path.name, digest=f"{path.name} found")
        for path in folders
    ]


@pytest.fixture
def given(tmp_path, monkeypatch):
    """Give a sweep of nine attacks, of which two a route are chosen."""
    pytest.importorskip("pyarrow")
    many = [row(f"c{seed}", "gradient", seed, seed / 10) for seed in range(9)]
    write_table(files.make_folder(tmp_path / "sweep") / "results.parquet", many)
    commands = Commands(tmp_path / "drives" / "remade" / "0" / "cells")
    monkeypatch.setattr("bench.commands.quality.run_command", commands)
    monkeypatch.setattr(f"{FOUND}.read_found", found_of)
    monkeypatch.setattr(f"{plots.__name__}.plot_transfer", lambda path, _: path.touch())
    monkeypatch.setattr(matrix.best_attacks, "__defaults__", (2,))
    return commands


def run(tmp_path, folder="drives", page="page", more=()):
    words = [str(tmp_path / folder), str(tmp_path / "sweep"), *more]
    return main(["matrix", *words, "-o", str(tmp_path / page)])


def test_the_command_chooses_drives_and_writes(tmp_path, given):
    parquet = pytest.importorskip("pyarrow.parquet")
    assert run(tmp_path) == 0
    again, first, *others = given.given
    assert again[:4] == [
        "reproduce",
        str(tmp_path / "sweep"),
        *(f"c{k}:{ROW}" for k in (8, 7)),
    ]
    assert first[1:3] == [str(given.remade / name) for name in ("c8", "c7")]
    assert "day" in first and "mujoco_gl_built_in" in first
    assert len(others) == 5 and all("day" not in words for words in others)
    text = (tmp_path / "page" / "README.md").read_text()
    assert "The 2 best attacks" in text and "99 of 99 columns" in text
    day, noon = (
        next(line for line in text.splitlines() if f"| {name} |" in line)
        for name in ("day", "noon")
    )
    assert day.startswith("| day | 0.100 | 0.400 ±") and "; 1/2 out [9, 91]" in day
    assert day.endswith("| 1.00 | 1/1 [21, 100] |")
    assert noon.endswith("| 0.50 | 0/1 [0, 79] |")
    assert "| c8 | **0.600** |" in text and "| c7 | 0.200 |" in text
    table = parquet.read_table(tmp_path / "page" / "drives.parquet").to_pylist()
    assert len(table) == 99 * 2 * 2
    assert (tmp_path / "drives" / "matrix.png").exists()
    again = matrix.document_of(table, ["c8", "c7"])
    plot_transfer(tmp_path / "matrix.png", again)
    assert again["conditions"] == list(Transfer.conditions)


def test_what_the_table_has_is_not_driven_again(tmp_path, given):
    """Not where it was interrupted, and not on another machine, either.

    The interrupted pass has all of the columns of c8, and all but one of c7.
    """
    given.fails_at, given.rows_until = 2, 2 * 6 * 3 - 1
    with pytest.raises(SystemExit):
        run(tmp_path)
    page = tmp_path / "page" / "README.md"
    assert "7 of 99 columns" in page.read_text()
    given.fails_at = None
    given.given.clear()
    assert run(tmp_path) == 0
    rest = given.transfers()
    assert rest[0][1:2] == [str(given.remade / "c7")] and rest[0][2] == "-o"
    assert len(rest) == 5 and "99 of 99 columns" in page.read_text()
    given.given.clear()
    assert run(tmp_path, "elsewhere") == 0 and not given.given


def test_a_table_of_other_settings_is_refused(tmp_path, given, capsys):
    """And another table in another folder has none of the first one's drives."""
    parquet = pytest.importorskip("pyarrow.parquet")
    assert run(tmp_path) == 0
    for option in ("--starts", "--spp"):
        assert run(tmp_path, more=[option, "4"]) == cli.EXIT_INPUT
        told = f"drives with {option[2:]} {8 if option == '--spp' else 1}, here 4"
        assert told in capsys.readouterr().err
    assert len(given.transfers()) == 6
    assert run(tmp_path, page="other", more=["--starts", "4"]) == 0
    assert len(given.transfers()) == 12
    rows = parquet.read_table(tmp_path / "other" / "drives.parquet").to_pylist()
    assert {row["starts"] for row in rows} == {4}


def test_attacks_that_were_found_with_other_digits_are_refused(
    tmp_path, given, monkeypatch, capsys
):
    given.fails_at = 2
    with pytest.raises(SystemExit):
        run(tmp_path)
    monkeypatch.setattr(
        f"{FOUND}.read_found",
        lambda folders: [SimpleNamespace(label=p.name, digest="0") for p in folders],
    )
    given.given.clear()
    assert run(tmp_path) == cli.EXIT_INPUT and not given.transfers()
    assert "c8 was found with other digits" in capsys.readouterr().err


def test_a_sweep_without_a_table_is_refused(tmp_path, given, capsys):
    del given
    few = ["matrix", str(tmp_path / "drives"), str(tmp_path / "none")]
    assert main(few) == cli.EXIT_INPUT and "results.parquet" in capsys.readouterr().err
