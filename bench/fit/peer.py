"""The other side of `bench fit`: training steps in PyTorch, on all cores."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch

from bench.full_ngp import NGPData
from bench.render.sides import COUNTED_RAYS, AbstractTrainer, Clock
from bench.torch import device
from bench.torch.encoding import PlainHashGrid, TunedHashGrid
from bench.torch.fit import Pictures, Plan, TorchFit
from mi_nerfattack.system.cores import cores

GRIDS = {"plain": PlainHashGrid, "tuned": TunedHashGrid}


class TorchTrainer(AbstractTrainer):
    """Training steps in PyTorch; a batch is worked off in the way that is fastest here.

    Args:
        style: of the encoding, a key of `GRIDS`.
        field: file of the field to start from.
        pictures: file of what to fit to.
        rays: of a step.
        chunk: rays in one graph; tried out with the field as it is when left out.
    """

    def __init__(
        self,
        style: str,
        field: Path,
        pictures: Path,
        rays: int,
        chunk: int | None = None,
    ) -> None:
        torch.set_num_threads(cores())
        data = NGPData.read(field)
        grid = GRIDS[style](data.layout)
        self.fit = TorchFit(data, grid, Pictures.read(pictures), rays)
        if chunk is not None:
            self.fit.plan = Plan(chunk)
        else:
            plans = Plan.candidates(rays)
            self._seconds(plans[0])  # warm up
            seconds = {plan: self._seconds(plan) for plan in plans}
            for plan in plans:
                seconds[plan] = min(seconds[plan], self._seconds(plan))
            self.fit.plan = min(plans, key=seconds.__getitem__)

    def steps(self, count: int) -> dict[str, float]:
        """See :meth:`AbstractTrainer.steps`."""
        clock = Clock()
        loss = sum(self.fit.step() for _ in range(count))
        device.wait()
        return {**clock.per_step(count), "loss": loss / count}

    def facts(self) -> dict[str, Any]:
        """Return rays and samples of a step, and settings."""
        return {
            "rays": self.fit.rays,
            "samples": self.fit.count_samples(COUNTED_RAYS),
            "threads": torch.get_num_threads(),
            "chunk_rays": self.fit.plan.chunk,
            "batches_by_rank": len(self.fit.plan.batches),
        }

    def memory(self) -> dict[str, float]:
        """Add what tensors took of a GPU, in MB."""
        return super().memory() | device.memory()

    def _seconds(self, plan: Plan) -> float:
        """Time the gradients of a batch; the field does not change."""
        self.fit.plan = plan
        drawn = self.fit.draw()
        start = time.perf_counter()
        self.fit.gradients(*drawn)
        device.wait()
        return time.perf_counter() - start
