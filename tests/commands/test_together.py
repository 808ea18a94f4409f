"""Verbs that begin while another process has only just begun the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_nerfattack.cli import main
from mi_nerfattack.io import locks

ROOM = Path(__file__).parents[2] / "scenes/room"
VIEWS = [ROOM / "scene.xml", "--routes", ROOM / "routes.json", "--views", 1]
VERBS = {
    "fit": (["fit", "absent", "-o", "a.safetensors"], "a.report"),
    "asset": (["asset", "absent.obj", "-o", "a.safetensors"], "a.report"),
    "capture": (["capture", *VIEWS, "-o", "out"], "out"),
    "photographs": (["capture", "absent", "-o", "out"], "out"),
}


@pytest.mark.parametrize("verb", VERBS)
def test_the_second_is_refused_and_leaves_nothing(
    verb, tmp_path, monkeypatch, variant, capsys
):
    """Before it reads anything; what it reads is missing where that is possible."""
    monkeypatch.chdir(tmp_path)
    words, claimed = VERBS[verb]
    Path(claimed).mkdir()
    with locks.exclusive(claimed):
        assert main([str(word) for word in words]) == 2
    assert f"{claimed}: another process works in it" in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == [claimed]
