"""The machine that this process works on."""

from __future__ import annotations

import os
import platform
import sys


def cores() -> int:
    """Return how many cores this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine() -> str:
    """Name the machine in records: cores, system and architecture."""
    return f"{cores()} cores, {platform.system()} {platform.machine()}"
