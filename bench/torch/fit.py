"""A training step in PyTorch: the peer of a step of `fit.fit.fit_ngp`.

Rays of random pixels with a random shift of their samples, the march and the field of
:mod:`bench.torch.ngp`, Huber loss of sRGB values, autograd, Adam.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from bench.ngp_data import NGPData
from bench.render.cameras import STOP
from bench.torch.ngp import TorchNGP
from mi_nerfattack.io import files

COUNTED_RAYS = 1 << 12  # of which the samples of a step are counted
ALL_AT_ONCE = ((0, 1 << 30),)  # faster than by ranks, with a graph
BELOW_WHITE = 1 - 1e-5  # as our loss does: the curve has no derivative above 1


@dataclass(frozen=True)
class Pictures:
    """The pixels of posed images with their rays.

    Attributes:
        colour: (images, pixels, 3), uint8 sRGB.
        origin: (images, 3), float32, metres.
        direction: (images, pixels, 3), float32, unit vectors.
    """

    colour: np.ndarray
    origin: np.ndarray
    direction: np.ndarray

    def write(self, path: Path) -> None:
        """Write all to a safetensors file."""
        files.write_safetensors(path, dict(vars(self)), {})

    @staticmethod
    def read(path: Path) -> Pictures:
        """Read what :meth:`write` wrote."""
        return Pictures(**files.read_safetensors(path)[0])


class TorchFit:
    """A field being fitted in PyTorch.

    Args:
        data: the field to start from; its occupancy stays as it is.
        pictures: what to fit to.
        rays: of a step.
        huber: where the loss turns linear, sRGB values.
        learning_rate: of Adam.
        seed: of pixels and shifts.

    Attributes:
        leaves: all that is trained.
        chunk: rays in one graph; gradients of chunks are added up.
    """

    def __init__(
        self,
        data: NGPData,
        pictures: Pictures,
        rays: int,
        huber: float = 0.1,
        learning_rate: float = 1e-2,
        seed: int = 0,
    ) -> None:
        self.model = TorchNGP(data, STOP)
        self.model.batches = ALL_AT_ONCE
        self.leaves = [*self.model.parameters.values(), self.model.sky]
        for leaf in self.leaves:
            leaf.requires_grad_(True)
        self.optimiser = torch.optim.Adam(
            self.leaves, lr=learning_rate, betas=(0.9, 0.99), eps=1e-15, fused=True
        )
        self.colour = torch.as_tensor(pictures.colour).reshape(-1, 3)
        self.direction = torch.as_tensor(pictures.direction).reshape(-1, 3)
        self.origin = torch.as_tensor(pictures.origin)
        self.pixels = pictures.colour.shape[1]
        self.rays, self.huber = rays, huber
        self.random = torch.Generator(torch.get_default_device()).manual_seed(seed)
        self.chunk = rays

    def step(self) -> float:
        """Do one step of the optimiser and return the loss before it."""
        loss = self.gradients(*self.draw())
        self.optimiser.step()
        return loss

    def draw(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw pixels with replacement, and shifts of samples; each (rays,)."""
        index = torch.randint(len(self.colour), (self.rays,), generator=self.random)
        return index, torch.rand(self.rays, generator=self.random)

    def gradients(self, index: torch.Tensor, jitter: torch.Tensor) -> float:
        """Replace the leaves' gradients by those of the mean loss; return that."""
        self.optimiser.zero_grad()
        total, chunk = 0.0, self.chunk
        for some, shift in zip(index.split(chunk), jitter.split(chunk), strict=True):
            loss = self.loss(some, shift) * (len(some) / len(index))
            loss.backward()
            total += float(loss.detach())
        return total

    def loss(self, index: torch.Tensor, jitter: torch.Tensor) -> torch.Tensor:
        """Return the mean over rays and channels of the Huber loss in sRGB.

        Args:
            index: (n,) pixels, image by image.
            jitter: (n,) in [0, 1), position of the samples in their intervals.
        """
        origin = self.origin[index // self.pixels]
        linear = self.model.render(origin, self.direction[index], jitter)
        target = self.colour[index].to(linear.dtype) / 255
        return F.smooth_l1_loss(encode(linear * BELOW_WHITE), target, beta=self.huber)

    def count_samples(self, rays: int) -> float:
        """Return the samples of a step in front of the end of their rays.

        Args:
            rays: of which to take the mean, at least.
        """
        self.model.evaluated, batches = 0, -(-rays // self.rays)
        with torch.no_grad():
            for _ in range(batches):
                self.loss(*self.draw())
        return self.model.evaluated / batches


def encode(linear: torch.Tensor) -> torch.Tensor:
    """Turn linear values in [0, 1] into sRGB."""
    dark = linear <= 0.0031308
    bright = torch.where(dark, 0.0031308, linear)
    return torch.where(dark, 12.92 * linear, 1.055 * bright ** (1 / 2.4) - 0.055)
