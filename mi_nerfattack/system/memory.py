"""How much memory the process has used."""

from __future__ import annotations

import re
import sys

from mi_nerfattack.io import files


def peak_memory_mb() -> float:
    """Return the largest resident size of this process so far, in MB.

    Not from `getrusage` on Linux: there a new process starts with its parent's peak.
    """
    if sys.platform == "linux":
        status = files.read_text("/proc/self/status")
        return float(re.findall(r"VmHWM:\s*(\d+) kB", status)[0]) * 1024 / 1e6
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
