"""Free pages go back to the system, where the C library is glibc."""

from __future__ import annotations

import ctypes
import mmap
import platform
from pathlib import Path

import pytest

from mi_nerfattack.system import heap

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
    heap._trim.cache_clear()
    assert not heap.release_heap()
    heap._trim.cache_clear()
