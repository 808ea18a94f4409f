"""Every verb in a folder that an ordinary user may not write to.

What it would read is missing, too, where that is possible: the output is looked at
before anything that takes long.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.modes import obeyed_modes

from mi_nerfattack.cli import main
from mi_nerfattack.commands import COMMANDS, each

SCENES = Path(__file__).parents[2] / "scenes"
ROOM = SCENES / "room"
VERBS = {
    "capture": ["capture", ROOM / "scene.xml", "--routes", ROOM / "routes.json", "-o"],
    "photographs": ["capture", SCENES, "-o"],
    "fit": ["fit", "absent", "-o"],
    "bake": ["bake", SCENES / "demo.toml", "-o"],
    "asset": ["asset", "absent", "-o"],
    "render": ["render", "frame", "absent", "-o"],
    "path": ["render", "path", "absent", "--path", "absent", "-o"],
    "train": ["train", "--data", "absent", "-o"],
    "evaluate": ["evaluate", "--output"],
    "page": ["evaluate", "--page"],
    "attack": ["attack", SCENES / "demo.toml", "-o"],
    "demo": ["demo", "-o"],
    "retrain": ["retrain", "absent", "--data", "absent", "-o"],
    "export": ["export", SCENES / "cube/field.safetensors", "-o"],
    "report": ["report", "absent", "-o"],
    "view": ["view", "absent", "-o"],
    "overlay": ["car", "overlay", "absent", "absent", "-o"],
    "check": ["check", SCENES / "demo.toml", "-o"],
    "transfer": ["transfer", "absent", "-o"],
    "refine": ["refine", "absent", "-o"],
    "sweep": ["sweep", "absent", "-o"],
    "reproduce": ["reproduce", "absent", "0", "-o"],
    "compare-drives": ["car", "compare", "absent", "absent", "-o"],
    "calibrate": ["car", "calibrate", "/dev/absent", "-o"],
    "drive": ["car", "drive", "--policy", "expert", "--simulated", "--log"],
}
ENDINGS = {
    "export": "glb",
    "render": "exr",
    "report": "html",
    "view": "html",
    "check": "png",
    "drive": "mcap",
}
FIELDS = ("fit", "bake", "asset", "train", "retrain")


def test_every_verb_that_writes_is_tried():
    without_output = {("doctor",), ("car", "monitor"), ("car", "serve")}
    verbs = {words for words, _ in each(COMMANDS)}
    tried = {one for one in verbs for given in VERBS.values() if begins(given, one)}
    assert tried == verbs - without_output


def begins(given, words):
    return tuple(given[: len(words)]) == words


@pytest.mark.parametrize("verb", VERBS)
def test_a_folder_without_permission_is_told_first(verb, tmp_path, variant, capsys):
    folder = tmp_path / "kept"
    folder.mkdir()
    folder.chmod(0o555)
    ending = "safetensors" if verb in FIELDS else ENDINGS.get(verb)
    output = folder / ("out" if ending is None else f"out.{ending}")
    with obeyed_modes():
        assert main([*map(str, VERBS[verb]), str(output)]) == 2
    error = capsys.readouterr().err
    assert f"{folder}/" in error and "permission denied; check the owner" in error
    folder.chmod(0o755)
    assert not list(folder.iterdir())
