"""Processes that work for this one: what they import, and what memory is theirs."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from mi_nerfattack.system.memory import peak_memory_mb
from mi_nerfattack.system.processes import module_command, safe_path


@pytest.fixture
def shadows(tmp_path, monkeypatch):
    """Work in a folder that has files named like Python's modules."""
    for name in ("json", "threading"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not of Python')\n")
    monkeypatch.chdir(tmp_path)


def test_module_is_run_by_pythons_own_modules(shadows, tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.mktemp("with blank")
    (folder / "says_json.py").write_text("import json, threading\nprint(json.dumps(1))")
    monkeypatch.syspath_prepend(str(folder))
    command = module_command("says_json")
    said = subprocess.run(command, capture_output=True, text=True, timeout=50)
    assert (said.stdout, said.stderr) == ("1\n", "")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 looks there")
def test_worker_starts_by_pythons_own_modules(shadows):
    process = multiprocessing.get_context("spawn").Process(target=time.sleep, args=[0])
    with safe_path():
        process.start()
    process.join(50)
    assert process.exitcode == 0
    assert "PYTHONSAFEPATH" not in os.environ


def test_a_process_does_not_inherit_the_peak_of_its_parent():
    """A child that only imports the package, of a parent that holds 800 MB more."""
    ballast = np.ones(100_000_000)
    code = "from mi_nerfattack.system import memory; print(memory.peak_memory_mb())"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert 20 < float(run.stdout) < 700
    assert peak_memory_mb() > ballast.nbytes / 1e6
