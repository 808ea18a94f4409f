"""The bundled demo finds what it claims to find."""

from __future__ import annotations

import json
import signal
import subprocess
import sys

import pytest
from helpers.faults import signalled

from mi_nerfattack import cli, scenes
from mi_nerfattack.io import files


@pytest.mark.usefixtures("variant")
def test_an_interrupted_demo_is_an_attack_that_can_go_on(
    scenario_folder, tmp_path, monkeypatch, capsys
):
    path, output = scenario_folder / "scenario.toml", tmp_path / "run"
    monkeypatch.setattr(scenes, "bundled", lambda name: path)
    with signalled("surrogate: optimisation", signal.SIGTERM, at=10):  # of 24
        assert cli.main(["demo", "-o", str(output), "--anyway"]) == 130
    assert "mi-nerfattack: interrupted" in capsys.readouterr().err
    kept, _ = files.read_safetensors(output / "checkpoint.safetensors")
    assert len(kept["history"]) == 1
    assert (output / "scenario.toml").is_file()


@pytest.mark.slow
def test_the_demo_beats_random_textures_and_transfers(tmp_path):
    output = tmp_path / "run"
    command = [sys.executable, "-m", "mi_nerfattack.cli", "demo", "-o", str(output)]
    done = subprocess.run(
        [*command, "--json"],
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    document = json.loads((output / "metrics.json").read_text())
    assert json.loads(done.stdout) == document
    harmless = ("not converged", "texture at its bounds")  # it has few iterations
    assert [f for f in document["flags"] if not f.startswith(harmless)] == []
    routes = document["routes"]["right"]
    means = {
        (environment, case): figures["cross_track_mean_m"]
        for environment, cases in routes.items()
        for case, figures in cases.items()
    }
    for environment, least in (("surrogate", 3.0), ("deployment", 2.0)):
        ratio = means[environment, "attack"] / means[environment, "random"]
        assert ratio >= least, f"{environment}: {ratio:.2f} times random textures"
        attacked = routes[environment]["attack"]
        assert attacked["drives_departed"] == attacked["n"] == 4
