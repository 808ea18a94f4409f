"""What a run has cost, over all processes that worked on it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from mi_nerfattack.system.memory import peak_memory_mb


@dataclass(frozen=True)
class Effort:
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

    def about(self) -> dict[str, str]:
        """Write the numbers as remarks of a kept file."""
        return {key: repr(value) for key, value in asdict(self).items()}

    @classmethod
    def from_about(cls, about: Mapping[str, str]) -> Effort:
        """Read the remarks of a kept file; what is missing counts 0."""
        whole = asdict(cls())
        return cls(**{k: type(v)(about.get(k, v)) for k, v in whole.items()})


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
            before.wall_s + time.perf_counter() - self._started,
            max(before.peak_memory_mb, peak_memory_mb()),
            before.renders + renders,
            before.checkpoint_s + checkpoint_s,
            before.processes + 1,
        )


def latest(*abouts: Mapping[str, Any]) -> Effort:
    """Return the effort of the file that was written last."""
    return max(map(Effort.from_about, abouts), key=lambda effort: effort.wall_s)
