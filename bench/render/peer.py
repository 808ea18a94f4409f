"""The other side: the same field and camera in PyTorch, on all cores."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.ngp_data import NGPData
from bench.render.cameras import STOP, route_rays
from bench.torch.ngp import TorchNGP
from bench.worker import wait

CHUNKS = (1024, 4096, 16384)  # rays at once


class TorchSide:
    """The field in PyTorch; rays go in chunks of the size that is fastest here.

    Chunk sizes are tried out on the middle eighth of the rays, for the image and for
    its derivative apart.

    Args:
        path: file of the field, from :class:`NGPData`.
        width, height: of the image, pixels.
        chunks: sizes to try.
        seed: of the image's cotangent.
    """

    def __init__(
        self,
        path: str,
        width: int,
        height: int,
        chunks: Sequence[int] = CHUNKS,
        seed: int = 0,
    ) -> None:
        self.model = TorchNGP(NGPData.read(Path(path)), STOP)
        self.origin, self.direction = map(torch.tensor, route_rays(width, height))
        cotangent = np.random.default_rng(seed).normal(size=(3, width * height))
        self.cotangent = torch.tensor(cotangent.T.astype(np.float32))
        middle = slice(len(self.origin) * 7 // 16, len(self.origin) * 9 // 16)
        self.chunk = fastest(chunks, lambda n: self._forward(n, middle))
        self.backward_chunk = fastest(chunks, lambda n: self._backward(n, middle)[1])

    def forward(self) -> float:
        """Render a frame and return the seconds it took."""
        return self._forward(self.chunk, slice(None))

    def backward(self) -> tuple[float, float]:
        """Return the seconds of the derivative, and with the graph's forward pass."""
        return self._backward(self.backward_chunk, slice(None))

    def facts(self) -> dict[str, Any]:
        """Return samples and settings."""
        self.model.evaluated = 0
        self.forward()
        return {
            "samples": self.model.evaluated,
            "threads": torch.get_num_threads(),
            "forward_chunk_rays": self.chunk,
            "backward_chunk_rays": self.backward_chunk,
        }

    def _forward(self, chunk: int, part: slice) -> float:
        start = time.perf_counter()
        with torch.no_grad():
            rays = zip(
                self.origin[part].split(chunk),
                self.direction[part].split(chunk),
                strict=True,
            )
            torch.cat([self.model.render(o, d) for o, d in rays])
        wait()
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
            wait()
            before = time.perf_counter()
            objective.backward()
            wait()
            alone += time.perf_counter() - before
        total = time.perf_counter() - start
        for value in self.model.parameters.values():
            value.requires_grad_(False)
        return alone, total


def fastest(choices: Sequence[int], measure: Callable[[int], float]) -> int:
    """Return the choice of the least seconds; one alone is not tried out."""
    if len(choices) == 1:
        return choices[0]
    measure(choices[0])  # warms up
    return min(choices, key=measure)
