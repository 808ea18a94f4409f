"""The curve of transfer against quality: its commands, in order, and its grid."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bench.__main__ import main
from bench.commands import quality
from mi_nerfattack import cli
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.experiment.sweep.reproduce import read_replay
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def commands(monkeypatch) -> list[list[str]]:
    """Commands that would be run; those of fits leave a field of their own."""
    given: list[list[str]] = []

    def run(words: list[str]) -> None:
        given.append([*words])
        if words[0] == "fit":
            bundled = quality.SCENES / "intersection" / "field.safetensors"
            shutil.copy(bundled, words[words.index("-o") + 1])

    monkeypatch.setattr(quality, "run_command", run)
    return given


@pytest.mark.slow
def test_table_2_is_attacked_in_every_field(commands, tmp_path, monkeypatch):
    folder, set_by = tmp_path / "quality", []
    monkeypatch.setattr("mi_nerfattack.variant.ensure", lambda: set_by.append(1))
    words = ["quality", str(folder), "--steps", "120", "600", "--seeds", "1"]
    assert main([*words, "--workers", "1"]) == 0
    assert [c[0] for c in commands] == ["capture", "fit", "fit", "sweep", "transfer"]
    assert set_by  # the command runs without one, other than this test
    capture, fit, _, sweep, transfer = commands
    assert Path(capture[1]).is_file() and capture[capture.index("-o") + 1] == fit[1]
    assert fit[fit.index("--steps") + 1] == "120" and "--step-m" in fit
    cells = load_cells(Path(sweep[1]))
    assert len(cells) == 3 * 3  # routes and fields
    fields = {}
    for cell in cells:
        assert cell.scenario.scene.field is not None
        fields[cell.method] = cell.scenario.scene.field.file
    assert fields["steps_120"] == folder / "fields" / "120.safetensors"
    assert fields["bundled"] == quality.SCENES / quality.FIELD
    assert transfer[1:10] == [str(folder / "sweep" / "cells" / c.id) for c in cells]
    # the bundled field's attacks are Table 2's own: what differs has no part in them
    pytest.importorskip("pyarrow")
    table2 = quality.SCENES.parent / "docs" / "table2"
    known = {
        (cell.route, cell.seed): cell.scenario.identity()
        for cell in read_replay(table2, [], 540).cells
    }
    for cell in cells:
        if cell.method == "bundled":
            own, theirs = cell.scenario.identity(), known[cell.route, cell.seed]
            keys = own.keys() | theirs.keys()
            differ = {key for key in keys if own.get(key) != theirs.get(key)}
            assert differ == {
                "scenario.baseline.textures",
                "scenario.baseline.deployment_textures",
                "scenario.drive.runs",
            }
    # what is there is not made again
    del commands[:]
    assert main([*words, "--workers", "1"]) == 0
    assert [c[0] for c in commands] == ["capture", "sweep", "transfer"]


def test_it_tells_what_it_would_do(commands, tmp_path, capsys):
    assert main(["quality", str(tmp_path / "new"), "--check"]) == 0
    told = capsys.readouterr().out
    assert "fields/2400.safetensors: mi-nerfattack fit" in told
    assert "3 routes x 5 places x 4 fields: 60 attacks" in told
    [check] = commands
    assert check[-1] == "--check"
    grid = files.read_toml(check[1])
    assert [m["name"] for m in grid["methods"]] == ["bundled"]
    assert len(grid["routes"]) == len(grid["seeds"]) == 1
    assert main(["quality", str(tmp_path), "--steps", "5", "5"]) == cli.EXIT_INPUT
