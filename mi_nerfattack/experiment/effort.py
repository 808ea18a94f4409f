"""What a run has cost, over all processes that worked on it."""

from __future__ import annotations

import time

from mi_nerfattack.io.resumable import Record
from mi_nerfattack.system.memory import peak_memory_mb


class Effort(Record):
    """Cost of a run.

    Attributes:
        wall_s: seconds; those between a killed process's last save and its end are
            unknown.
        peak_memory_mb: of the process that needed most.
        renders: frames.
        checkpoint_s: seconds spent on writing checkpoints.
        processes: how many have worked on the run.
    """

    wall_s: float = 0.0
    peak_memory_mb: float = 0.0
    renders: int = 0
    checkpoint_s: float = 0.0
    processes: int = 0


class Account:
    """Adds what this process does to what earlier ones did.

    Args:
        started: `time.perf_counter()` at the start of this process's work.
        before: effort of the earlier processes.
    """

    def __init__(self, started: float, before: Effort) -> None:
        self._started, self._before = started, before

    def total(self, renders: int, checkpoint_s: float) -> Effort:
        """Return the effort so far.

        Args:
            renders: frames of this process.
            checkpoint_s: seconds of this process.
        """
        before = self._before
        return Effort(
            wall_s=before.wall_s + time.perf_counter() - self._started,
            peak_memory_mb=max(before.peak_memory_mb, peak_memory_mb()),
            renders=before.renders + renders,
            checkpoint_s=before.checkpoint_s + checkpoint_s,
            processes=before.processes + 1,
        )
