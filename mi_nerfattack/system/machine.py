"""Cores and memory: those of this process and of the processes that it started."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
from functools import cache
from typing import Any

from mi_nerfattack.io import files


def release_heap() -> bool:
    """Give pages of the heap that hold nothing back to the system, in a millisecond.

    glibc keeps torch's buffers in its heap, between small blocks that live on: free
    pages then add up with the length of a drive. Other C libraries are left alone.

    Returns:
        whether there were any.
    """
    trim = _trim()
    return trim is not None and trim(0) == 1


@cache
def _trim() -> Any:
    """Return glibc's ``malloc_trim``, or None."""
    if platform.libc_ver()[0] != "glibc":
        return None
    return ctypes.CDLL(None).malloc_trim


def cores() -> int:
    """Return how many cores this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine() -> str:
    """Name the machine in records: cores, system and architecture."""
    return f"{cores()} cores, {platform.system()} {platform.machine()}"


def peak_memory_mb() -> float:
    """Return the largest resident size of this process so far, in MB.

    Not from `getrusage` on Linux: there a new process starts with its parent's peak.
    """
    if sys.platform == "linux":
        status = files.read_text("/proc/self/status")
        return float(re.findall(r"VmHWM:\s*(\d+) kB", status)[0]) * 1024 / 1e6
    return _peak_mb(of_children=False)


def peak_of_children_mb() -> float:
    """Return the largest resident size of processes of this one that ended, in MB.

    At least this process's own when it started them; 0 without any.
    """
    return _peak_mb(of_children=True)


def _peak_mb(of_children: bool) -> float:
    import resource  # not on Windows

    whose = resource.RUSAGE_CHILDREN if of_children else resource.RUSAGE_SELF
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(whose).ru_maxrss * unit / 1e6
