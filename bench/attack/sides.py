"""What a side of `bench attack` can be asked."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from mi_nerfattack.system.memory import peak_memory_mb


class AbstractAttack(ABC):
    """An attack on a texture through the closed loop, in a process of its own."""

    @abstractmethod
    def iterate(self, how: str) -> dict[str, float]:
        """Do an iteration: drive, differentiate, update the texture by Adam.

        Args:
            how: a side's own name of a way; the empty string where it has one only.

        Returns:
            ``seconds`` and ``cpu_seconds``.
        """

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Return what is not timed; may drive once more."""

    def memory(self) -> dict[str, float]:
        """Return the largest resident size of the process so far, in MB."""
        return {"peak_memory_mb": peak_memory_mb()}
