"""The other side: the same field and camera in PyTorch, on all cores."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from bench.full_ngp import NGPData
from bench.render.sides import STOP, AbstractSide, route_rays
from bench.torch import device
from bench.torch.encoding import PlainHashGrid, TunedHashGrid
from bench.torch.ngp import TorchNGP
from mi_nerfattack.system.cores import cores

GRIDS = {"plain": PlainHashGrid, "tuned": TunedHashGrid}
CHUNKS = (1024, 4096, 16384)  # rays at once


class TorchSide(AbstractSide):
    """The field in PyTorch; rays go in chunks of the size that is fastest here.

    Chunk sizes are tried out on the middle eighth of the rays, for the image and for
    its derivative apart.

    Args:
        style: of the encoding, a key of `GRIDS`.
        data: the field.
        width, height: of the image, pixels.
        chunks: sizes to try.
        seed: of the image's cotangent.
    """

    def __init__(
        self,
        style: str,
        data: NGPData,
        width: int,
        height: int,
        chunks: tuple[int, ...] = CHUNKS,
        seed: int = 0,
    ) -> None:
        torch.set_num_threads(cores())
        self.model = TorchNGP(data, GRIDS[style](data.layout), STOP)
        self.origin, self.direction = map(torch.tensor, route_rays(width, height))
        cotangent = np.random.default_rng(seed).normal(size=(3, width * height))
        self.cotangent = torch.tensor(cotangent.T.astype(np.float32))
        middle = slice(len(self.origin) * 7 // 16, len(self.origin) * 9 // 16)
        self.chunk = _fastest(chunks, lambda n: self._forward(n, middle))
        self.backward_chunk = _fastest(chunks, lambda n: self._backward(n, middle)[1])

    def forward(self) -> float:
        """See :meth:`AbstractSide.forward`."""
        return self._forward(self.chunk, slice(None))

    def backward(self) -> tuple[float, float]:
        """See :meth:`AbstractSide.backward`; the graph's forward pass is in the sum."""
        return self._backward(self.backward_chunk, slice(None))

    def facts(self) -> dict[str, Any]:
        """Return samples, the share of those that were evaluated in vain, settings."""
        self.model.evaluated = 0
        self.forward()
        return {
            "samples": self.model.evaluated,
            "threads": torch.get_num_threads(),
            "forward_chunk_rays": self.chunk,
            "backward_chunk_rays": self.backward_chunk,
        }

    def memory(self) -> dict[str, float]:
        """Add what tensors took of a GPU, in MB."""
        return super().memory() | device.memory()

    def _forward(self, chunk: int, part: slice) -> float:
        start = time.perf_counter()
        with torch.no_grad():
            rays = zip(
                self.origin[part].split(chunk),
                self.direction[part].split(chunk),
                strict=True,
            )
            torch.cat([self.model.render(*some) for some in rays])
        device.wait()
        return time.perf_counter() - start

    def _backward(self, chunk: int, part: slice) -> tuple[float, float]:
        alone, start = 0.0, time.perf_counter()
        for value in self.model.parameters.values():
            value.grad = None
            value.requires_grad_(True)
        pieces = (self.origin, self.direction, self.cotangent)
        for origin, direction, cotangent in zip(
            *(piece[part].split(chunk) for piece in pieces), strict=True
        ):
            objective = (self.model.render(origin, direction) * cotangent).sum()
            device.wait()
            before = time.perf_counter()
            objective.backward()
            device.wait()
            alone += time.perf_counter() - before
        total = time.perf_counter() - start
        for value in self.model.parameters.values():
            value.requires_grad_(False)
        return alone, total


def _fastest(chunks: tuple[int, ...], measure: Callable[[int], float]) -> int:
    if len(chunks) == 1:
        return chunks[0]
    measure(chunks[0])
    return min(chunks, key=measure)
