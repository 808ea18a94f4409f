"""The examples are short, and run unchanged."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
SCRIPTS = sorted((DOCS / "examples").glob("*_user.py"))


def run(name: str, folder: Path) -> list[float]:
    """Run an example in a folder; return the last number of each line printed."""
    script = DOCS / f"examples/{name}.py"
    done = subprocess.run(
        [sys.executable, script], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    numbers = [re.findall(r"-?\d+\.\d+", line) for line in done.stdout.splitlines()]
    return [float(found[-1]) for found in numbers if found]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_examples_are_short(script):
    assert len(script.read_text("utf-8").splitlines()) <= 60


@pytest.mark.slow
def test_mitsuba_user(tmp_path):
    first, *_, last = run("mitsuba_user", tmp_path)
    assert last < first / 2
    assert (tmp_path / "before.png").read_bytes() != (
        tmp_path / "after.png"
    ).read_bytes()


@pytest.mark.slow
def test_pytorch_user(tmp_path):
    *errors, _, _ = run("pytorch_user", tmp_path)
    assert len(errors) == 5 and errors[-1] > errors[0]


@pytest.mark.slow
def test_robotics_user(tmp_path):
    errors = run("robotics_user", tmp_path)  # the expert's
    assert len(errors) == 3 and max(errors) < 0.3


@pytest.mark.slow
def test_renderer_user(tmp_path):
    *_, psnr_db = run("renderer_user", tmp_path)
    assert psnr_db > 20
    assert (tmp_path / "hydrant.png").stat().st_size
    assert (tmp_path / "hydrant.safetensors").stat().st_size


@pytest.mark.slow
def test_gymnasium_user(tmp_path):
    *returns, best = run("gymnasium_user", tmp_path)
    assert best == max(returns) > min(returns)
    assert (tmp_path / "drive.gif").stat().st_size
