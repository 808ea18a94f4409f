"""The other side of `bench attack`: the loop in PyTorch, on all cores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bench.attack.drive import (
    MAX_HEADING_RATE,
    MOUNT,
    RATE,
    ROUNDING_M,
    SPEED_MS,
    Job,
    network,
    route,
)
from bench.ngp_data import NGPData
from bench.render.cameras import STOP
from bench.render.peer import CHUNKS, fastest
from bench.torch.loop import (
    TorchCamera,
    TorchLoop,
    TorchRoute,
    TorchVehicle,
    TorchView,
)
from bench.torch.ngp import TorchNGP
from bench.torch.object import ObjectData, TorchObject
from bench.worker import Clock, wait


class TorchAttack:
    """Iterations in PyTorch; rays of the background go in chunks of the fastest size.

    Args:
        scene: file of the background, from :class:`NGPData`.
        item: file of the object, from :class:`ObjectData`.
        values: what is driven, the values of a :class:`Job`.
        chunks: sizes to try.
    """

    def __init__(
        self,
        scene: str,
        item: str,
        values: Sequence[int],
        chunks: Sequence[int] = CHUNKS,
    ) -> None:
        self.job = job = Job(*values)
        ngp = TorchNGP(NGPData.read(Path(scene)), STOP)
        self.item = TorchObject(ObjectData.read(Path(item)), STOP)
        self.item.texture.requires_grad_(True)
        camera = TorchCamera(job.camera, MOUNT)
        self.view = TorchView(ngp, self.item, camera, chunk=chunks[0])
        path = route()
        self.loop = TorchLoop(
            self.view,
            network(),
            transforms=job.transforms(),
            goal=path.goal,
            vehicle=TorchVehicle(SPEED_MS, MAX_HEADING_RATE, job.dt),
            route=TorchRoute(path.points, ROUNDING_M),
        )
        self.initial = torch.tensor(job.initial())
        self.optimiser = torch.optim.Adam([self.item.texture], RATE, fused=True)
        self.view.chunk = fastest(chunks, self._march)

    def iterate(self) -> dict[str, float]:
        """Drive, differentiate, and update the texture by Adam.

        Returns:
            ``seconds`` and ``cpu_seconds``.
        """
        clock = Clock()
        states = self.loop.drive(self.initial, self.job.horizon)
        self.loop.objective(states).backward()
        self.optimiser.step()
        self.optimiser.zero_grad()
        wait()
        return clock.per_step()

    def facts(self) -> dict[str, Any]:
        """Return settings."""
        return {"threads": torch.get_num_threads(), "chunk_rays": self.view.chunk}

    def _march(self, chunk: int) -> float:
        """Time the background of the first frame."""
        rays = self.view.camera.rays(self.initial[:1])
        self.view.chunk, clock = chunk, Clock()
        with torch.no_grad():
            self.view.background(*rays)
        wait()
        return clock.per_step()["seconds"]
