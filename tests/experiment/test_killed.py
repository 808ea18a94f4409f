"""Attacks that are killed (SIGKILL) at random moments, and go on.

More kills than by default:

    KILLS=200 python -m pytest -m slow -s tests/experiment/test_killed.py
"""

from __future__ import annotations

import os
import random
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from support.worlds.attacks import write_scenario

from mi_nerfattack.io import files, locks
from mi_nerfattack.system.processes import module_command

KILLS = int(os.environ.get("KILLS", "3"))
RESULTS = ("attack.json", "objects/ball.safetensors", "steps.csv")


def partial(output: Path) -> list[Path]:
    """Return the files that are being written, or were when their process died."""
    return [path for path in output.rglob(".*") if locks.is_partial(path)]


def is_killed(
    command: Sequence[str], output: Path, moment_s: float, in_file: bool
) -> bool:
    """Kill a process after a time, or at its next file after it; False if it ends."""
    end = time.monotonic() + moment_s
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=silent, stderr=silent)
    while process.poll() is None:
        if time.monotonic() > end and (not in_file or partial(output)):
            process.kill()
            return process.wait() != 0
        time.sleep(1e-3)
    assert process.returncode == 0
    return False


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_killed_attacks_end_as_one_that_was_not(tmp_path):
    """What has a name is whole, the results are equal to the bit, nothing is left."""
    scenario = write_scenario(tmp_path / "scenario") / "scenario.toml"
    words = "attack", str(scenario), "--anyway", "--pictures", "none", "--workers", "1"
    command = [*module_command("mi_nerfattack.cli"), *words, "-o"]
    intact, drawn, kills, runs, in_files = tmp_path / "whole", random.Random(0), 0, 0, 0
    subprocess.run([*command, str(intact)], check=True)
    start = time.monotonic()
    subprocess.run([*command, str(tmp_path / "again")], check=True)
    longest_s = time.monotonic() - start
    while kills < KILLS:
        output, runs = tmp_path / f"run{runs}", runs + 1
        mine = [*command, str(output)]
        while kills < KILLS and is_killed(
            mine, output, drawn.uniform(0, longest_s), in_file=kills % 2 == 1
        ):
            kills += 1
            in_files += bool(partial(output))
            for path in output.rglob("*.safetensors"):
                files.read_safetensors(path)
        subprocess.run(mine, check=True)
        for name in RESULTS:
            assert (intact / name).read_bytes() == (output / name).read_bytes(), name
        one, other = (files.read_json(p / "metrics.json") for p in (intact, output))
        assert one["routes"] == other["routes"] and not partial(output)
    print(f"{kills} kills, {in_files} of them within a file, {runs} attacks")
