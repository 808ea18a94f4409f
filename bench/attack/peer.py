"""The other side of `bench attack`: the loop in PyTorch, on all cores."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from bench.attack.drive import (
    BAKED,
    MAX_HEADING_RATE,
    MOUNT,
    RATE,
    ROUNDING_M,
    SPEED_MS,
    Job,
    network,
    route,
)
from bench.attack.sides import AbstractAttack
from bench.full_ngp import NGPData
from bench.render.peer import CHUNKS, GRIDS
from bench.render.sides import STOP, Clock
from bench.torch import device
from bench.torch.bricks import TorchBricks
from bench.torch.loop import (
    Resized,
    TorchCamera,
    TorchLoop,
    TorchRoute,
    TorchVehicle,
    TorchView,
)
from bench.torch.ngp import TorchNGP
from bench.torch.object import (
    AbstractLookup,
    BagLookup,
    ObjectData,
    SelectLookup,
    TorchObject,
)
from mi_nerfattack.system.cores import cores

NEAR_M = 9.0  # along the road, where the object is large
LOOKUPS: dict[str, AbstractLookup] = {"bag": BagLookup(), "select": SelectLookup()}


class TorchAttack(AbstractAttack):
    """Iterations in PyTorch; chunks and lookups are those that are fastest here.

    They are tried out on the first frame and on one in the middle of the road.

    Args:
        style: of the background's encoding, a key of `GRIDS`; or ``baked``.
        scene: file of the background, from :class:`NGPData`; or of its bricks.
        item: file of the object, from :class:`ObjectData`.
        job: what is driven.
        chunks: of the background's rays, sizes to try.
        lookups: keys of `LOOKUPS` to try.
    """

    def __init__(
        self,
        style: str,
        scene: Path,
        item: Path,
        job: Job,
        chunks: tuple[int, ...] = CHUNKS,
        lookups: tuple[str, ...] = tuple(LOOKUPS),
    ) -> None:
        torch.set_num_threads(cores())
        self.job = job
        ngp = _scene(style, scene)
        self.item = TorchObject(ObjectData.read(item), LOOKUPS[lookups[0]], STOP)
        self.item.texture.requires_grad_(True)
        camera = TorchCamera(job.camera, MOUNT)
        self.view = TorchView(ngp, self.item, camera, chunks[0])
        path = route()
        self.loop = TorchLoop(
            self.view,
            Resized(network(), job.transforms()),
            path.goal,
            TorchVehicle(SPEED_MS, MAX_HEADING_RATE, job.dt),
            TorchRoute(path.points, ROUNDING_M),
        )
        self.initial = torch.tensor(job.initial())
        self.optimiser = torch.optim.Adam([self.item.texture], RATE, fused=True)
        self.lookup = lookups[0]
        self._choose(chunks, lookups)

    def iterate(self, how: str = "") -> dict[str, float]:
        """See :meth:`AbstractAttack.iterate`; there is one way.

        Also returns ``tape_mb``: what the graph keeps of a control period.
        """
        del how
        tape = Tape([self.item.texture, *self.loop.policy.parameters()])
        clock = Clock()
        with tape:
            states = self.loop.drive(self.initial, self.job.horizon)
        self.loop.objective(states).backward()
        self.optimiser.step()
        self.optimiser.zero_grad()
        device.wait()
        return {**clock.per_step(1), "tape_mb": tape.size / 1e6 / self.job.horizon}

    def facts(self) -> dict[str, Any]:
        """Return settings."""
        return {
            "threads": torch.get_num_threads(),
            "chunk_rays": self.view.chunk,
            "lookup": self.lookup,
        }

    def memory(self) -> dict[str, float]:
        """Add what tensors took of a GPU, in MB."""
        return super().memory() | device.memory()

    def _choose(self, chunks: tuple[int, ...], lookups: tuple[str, ...]) -> None:
        """Try out what there is to choose from."""
        near = self.initial.clone()
        near[:, 0] += NEAR_M
        if len(chunks) > 1:
            origin, direction = self.view.camera.rays(self.initial[:1])

            def march(chunk: int) -> float:
                self.view.chunk = chunk
                with torch.no_grad():
                    return _seconds(lambda: self.view.background(origin, direction))

            self.view.chunk = _best(chunks, march)
        if len(lookups) > 1:
            rays = self.view.camera.rays(near)

            def see(name: str) -> float:
                self.item.lookup = LOOKUPS[name]
                return _seconds(lambda: self.item.see(*rays).radiance.sum().backward())

            self.lookup = _best(lookups, see)
            self.item.lookup = LOOKUPS[self.lookup]
            self.optimiser.zero_grad()


def _scene(style: str, path: Path) -> TorchNGP:
    if style == BAKED:
        return TorchBricks(path, STOP)
    data = NGPData.read(path)
    return TorchNGP(data, GRIDS[style](data.layout), STOP)


class Tape(torch.autograd.graph.saved_tensors_hooks):
    """Counts the bytes that autograd keeps for a backward pass.

    Args:
        parameters: not counted, for they exist anyway.

    Attributes:
        size: bytes, each piece of memory once.
    """

    def __init__(self, parameters: Sequence[torch.Tensor]) -> None:
        self.size = 0
        self._known = {_memory_of(value) for value in parameters}
        super().__init__(self._count, _same)

    def _count(self, value: torch.Tensor) -> torch.Tensor:
        if _memory_of(value) not in self._known:
            self._known.add(_memory_of(value))
            self.size += value.untyped_storage().nbytes()
        return value


def _memory_of(value: torch.Tensor) -> int:
    return value.untyped_storage().data_ptr()


def _same(value: torch.Tensor) -> torch.Tensor:
    return value


def _seconds(action: Callable[[], Any]) -> float:
    start = time.perf_counter()
    action()
    device.wait()
    return time.perf_counter() - start


def _best(choices: Sequence[Any], measure: Callable[[Any], float]) -> Any:
    """Return the fastest choice of two rounds; the first one also warms up."""
    rounds = [{choice: measure(choice) for choice in choices} for _ in range(2)]
    return min(choices, key=lambda choice: min(times[choice] for times in rounds))
