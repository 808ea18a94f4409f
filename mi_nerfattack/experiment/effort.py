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
        forward_s: seconds of the attack's drives; the first of each process, which
            compiles, is left out.
        backward_s: seconds of the passes back through them, likewise.
    """

    wall_s: float = 0.0
    peak_memory_mb: float = 0.0
    renders: int = 0
    checkpoint_s: float = 0.0
    processes: int = 0
    forward_s: float = 0.0
    backward_s: float = 0.0

    @property
    def backward_multiple(self) -> float:
        """Cost of a pass back, in drives; 1 where none was measured."""
        return self.backward_s / self.forward_s if self.forward_s else 1.0


class Account:
    """Adds what this process does to what earlier ones did.

    Args:
        started: `time.perf_counter()` at the start of this process's work.
        before: effort of the earlier processes.
    """

    def __init__(self, started: float, before: Effort) -> None:
        self._started, self._before = started, before
        self._passes = [0.0, 0.0]
        self._compiled = False

    def add_iteration(self, forward_s: float, backward_s: float) -> None:
        """Add the seconds of an iteration of the attack."""
        if self._compiled:
            self._passes[0] += forward_s
            self._passes[1] += backward_s
        self._compiled = True

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
            forward_s=before.forward_s + self._passes[0],
            backward_s=before.backward_s + self._passes[1],
        )
