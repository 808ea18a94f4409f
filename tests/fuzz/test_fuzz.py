"""Damaged files of every format are read, or refused by our error.

`make test` tries 100 of each, and always the same, `make test-all` 1,000. What
`make test-fuzz` tried stands in `tried.csv`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.formats import FORMATS

COUNT = 100


def fuzz(*arguments: object) -> None:
    """Fuzz in a process without threads, which can fork."""
    tests = Path(__file__).parents[1]
    result = subprocess.run(
        [sys.executable, "-m", "fuzz.run", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": f"{tests}{os.pathsep}{tests.parent}"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_damaged_files_are_read_or_refused():
    fuzz("--count", COUNT)


#: Numbers of inputs that once escaped, drawn by the seed of `tried.csv`.
ESCAPED = {
    "scenario": [8181],
    "grid": [26944, 34681],
    "onnx": [2108],
    "checkpoint": [5544],
    "zed": [7987],
    "video": [13528],
}


@pytest.mark.parametrize("name", ESCAPED)
def test_inputs_that_once_escaped(name):
    for number in ESCAPED[name]:
        fuzz(name, "--seed", 20261128, "--only", number)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_many_damaged_files_are_read_or_refused(name):
    fuzz(name, "--count", 10 * COUNT)
