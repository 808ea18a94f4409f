"""Processes that work for this one, what memory is theirs, and free pages."""

from __future__ import annotations

import ctypes
import mmap
import multiprocessing
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mi_nerfattack.system import machine as heap
from mi_nerfattack.system.machine import peak_memory_mb
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
    code = "from mi_nerfattack.system import machine; print(machine.peak_memory_mb())"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert 20 < float(run.stdout) < 700
    assert peak_memory_mb() > ballast.nbytes / 1e6


# Below 128 KiB, from where glibc maps blocks; too block to fill gaps that there are.
BLOCK, BETWEEN, COUNT = 100_000, 20_000, 1000


def resident_bytes() -> int:
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * mmap.PAGESIZE


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's own function")
def test_pages_between_small_blocks_are_released():
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    blocks = [(libc.malloc(BLOCK), libc.malloc(BETWEEN)) for _ in range(COUNT)]
    for block, _ in blocks:
        ctypes.memset(block, 1, BLOCK)
    for block, _ in blocks:
        libc.free(ctypes.c_void_p(block))
    before = resident_bytes()
    assert heap.release_heap()
    assert before - resident_bytes() > 0.8 * BLOCK * COUNT
    for _, small in blocks:
        libc.free(ctypes.c_void_p(small))


@pytest.mark.parametrize("library", ["", "musl"])  # macOS and Windows; Alpine
def test_other_libraries_are_left_alone(library, monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: (library, ""))
    monkeypatch.setattr(ctypes, "CDLL", None)
    monkeypatch.setattr(heap, "_trim", heap._trim.__wrapped__)  # without its cache
    assert not heap.release_heap()
