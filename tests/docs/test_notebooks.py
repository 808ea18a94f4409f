"""Notebooks run with small settings; the site runs them as they are."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.pages.blocks import fenced

FOLDER = Path(__file__).parents[2] / "docs/notebooks"
# A notebook's line of settings, smaller ones, and what the printed numbers show.
SMALL = {
    "fields": (
        "size_px, steps = 96, 24",
        "size_px, steps = 32, 6",
        lambda x: x[1] < x[0] and x[3] < x[2] and x[5] < x[4],
    ),
    "glass": (
        'size = {"width": 320, "height": 160}',
        'size = {"width": 80, "height": 40}',
        lambda x: x[0] > 0 > x[1],
    ),
    "closed_loop": (
        "horizon, iterations = 20, 6",
        "horizon, iterations = 4, 2",
        lambda x: x[0] >= 0 and x[1] >= 0 and 0.05 <= x[2] <= 0.15,  # two steps
    ),
    "policy": (
        "horizon, period = 20, 12",
        "horizon, period = 4, 2",
        lambda x: x[0] > 0,
    ),
    "photographs": (
        "steps = 12, 480, 400",
        "steps = 12, 480, 50",
        lambda x: x[0] > 10,  # dB
    ),
}


def test_every_notebook_has_small_settings():
    names = {path.stem for path in FOLDER.glob("*.md")} - {"index"}
    assert names == set(SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_notebook_runs(name):
    line, smaller, holds = SMALL[name]
    script = "\n".join(fenced(FOLDER / f"{name}.md", "{code-cell} python"))
    assert script.count(line) == 1
    done = subprocess.run(
        [sys.executable, "-c", script.replace(line, smaller)],
        cwd=FOLDER,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    printed = [float(x) for x in re.findall(r"-?\d+\.\d+", done.stdout)]
    assert holds(printed), done.stdout
