"""Verbs that write single files, interrupted while they write."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import pytest
from helpers.made_runs import make_run

from mi_nerfattack.cli import main

CUBE = Path(__file__).parents[2] / "scenes/cube/field.safetensors"


@pytest.mark.parametrize("verb", ["export", "report"])
def test_what_is_interrupted_leaves_nothing(
    verb, tmp_path, variant, monkeypatch, capsys
):
    scratch, folder = tmp_path / "scratch", tmp_path / "out"
    scratch.mkdir()
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    source, output = CUBE, folder / "a.glb"
    if verb == "report":
        source, output = tmp_path / "run", folder / "a.html"
        make_run(source)
    output.write_text("old")
    write = os.write

    def interrupt(descriptor: int, data: bytes) -> int:
        signal.raise_signal(signal.SIGTERM)
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", interrupt)
    assert main([verb, str(source), "-o", str(output)]) == 130
    assert "mi-nerfattack: interrupted" in capsys.readouterr().err
    assert output.read_text() == "old" and list(folder.iterdir()) == [output]
    assert not list(scratch.iterdir())
