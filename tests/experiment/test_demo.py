"""The bundled demo finds what it claims to find."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest


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
    means = {
        (environment, case): figures["cross_track_mean_m"]
        for environment, cases in document["routes"]["right"].items()
        for case, figures in cases.items()
    }
    for environment, least in (("surrogate", 3.0), ("deployment", 2.0)):
        ratio = means[environment, "attack"] / means[environment, "random"]
        assert ratio >= least, f"{environment}: {ratio:.2f} times random textures"
