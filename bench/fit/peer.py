"""The other side of `bench fit`: training steps in PyTorch, on all cores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from bench.ngp_data import NGPData
from bench.render.peer import fastest
from bench.torch.fit import COUNTED_RAYS, Pictures, TorchFit
from bench.worker import Clock, wait


class TorchTrainer:
    """Training steps in PyTorch; a batch is worked off in the way that is fastest here.

    Args:
        field: file of the field to start from.
        pictures: file of what to fit to.
        rays: of a step.
        chunk: rays in one graph; tried out with the field as it is when left out.
    """

    def __init__(
        self,
        field: str,
        pictures: str,
        rays: int,
        chunk: int | None = None,
    ) -> None:
        data = NGPData.read(Path(field))
        self.fit = TorchFit(data, Pictures.read(Path(pictures)), rays)
        choices = [rays, max(1, rays // 4)] if chunk is None else [chunk]
        self.fit.chunk = fastest(choices, self._seconds)

    def steps(self, count: int) -> dict[str, float]:
        """Do training steps, as :meth:`OurTrainer.steps` does."""
        clock = Clock()
        loss = sum(self.fit.step() for _ in range(count))
        wait()
        return {**clock.per_step(count), "loss": loss / count}

    def facts(self) -> dict[str, Any]:
        """Return rays and samples of a step, and settings."""
        return {
            "rays": self.fit.rays,
            "samples": self.fit.count_samples(COUNTED_RAYS),
            "threads": torch.get_num_threads(),
            "chunk_rays": self.fit.chunk,
        }

    def _seconds(self, chunk: int) -> float:
        """Time the gradients of a batch; the field does not change."""
        self.fit.chunk, drawn, clock = chunk, self.fit.draw(), Clock()
        self.fit.gradients(*drawn)
        wait()
        return clock.per_step()["seconds"]
