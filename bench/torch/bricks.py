"""The peer's march through bricks: the same file, looked up in PyTorch."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import torch

from bench.torch.ngp import BATCHES, TorchNGP, halves
from bench.torch.window import TorchWindow
from mi_nerfattack.io import files


class TorchBricks(TorchNGP):
    """A brick field at the identity pose; see `mi_nerfattack.fields.bricks`.

    Args:
        path: field file of `mi-nerfattack bake`.
        stop: transmittance at which a ray ends.
    """

    def __init__(self, path: Path, stop: float) -> None:
        tensors, header = files.read_safetensors(path)
        numbers = {
            key: [float(word) for word in header[key].split()]
            for key in ("lower", "upper", "occupancy_shape", "log_density")
        }
        shape = [int(n) for n in numbers["occupancy_shape"]]
        bits = np.unpackbits(tensors["occupancy"], count=int(np.prod(shape)))
        cells = bits.reshape(shape).astype(bool)
        octants = np.zeros(shape, np.uint8)
        octants[cells] = tensors["octants"]
        self.limit, self.batches, self.evaluated = -math.log(stop), BATCHES, 0
        self.parameters, self.density_scale = {}, 1.0
        self.lower = torch.tensor(numbers["lower"])
        self.extent = torch.tensor(numbers["upper"]) - self.lower
        self.occupied = torch.as_tensor(halves(octants))
        self.window = TorchWindow(cells)
        self.step, self.cone = float(header["step_m"]), float(header["cone"])
        self.cone = max(self.cone, 1e-12)
        self.sky = torch.as_tensor(tensors["sky"])
        divided = tensors["subdivisions"].astype(np.int64)
        ends = np.cumsum((divided + 1) ** 3)
        first, parts = np.zeros(shape, np.int32), np.ones(shape, np.int32)
        first[cells], parts[cells] = np.append(0, ends[:-1]), divided
        self.first = torch.as_tensor(first.ravel())
        self.parts = torch.as_tensor(parts.ravel())
        vertices = tensors["vertices"].view(np.uint8).reshape(-1, 4)
        self.vertices = torch.as_tensor(vertices.copy())
        self.low, high = numbers["log_density"]
        self.scale = (high - self.low) / 255

    def _geometry(self, unit: torch.Tensor) -> torch.Tensor:
        """Return logarithm of the density and sRGB colour, (n, 4)."""
        shape = torch.tensor([n // 2 for n in self.occupied.shape])
        scaled = unit * shape
        cell = torch.minimum(scaled.floor(), shape - 1)
        row = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
        row = row.to(torch.int32)
        parts = self.parts.index_select(0, row)
        place = (scaled - cell) * parts[:, None]
        low = torch.minimum(place.floor(), parts[:, None] - 1)
        part, low = place - low, low.to(torch.int32)
        side = parts + 1
        start = self.first.index_select(0, row)
        start += (low[:, 0] * side + low[:, 1]) * side + low[:, 2]
        total = torch.zeros(len(unit), 4)
        for i, j, k in itertools.product((0, 1), repeat=3):
            x, y, z = (
                part[:, axis] if c else 1 - part[:, axis]
                for axis, c in enumerate((i, j, k))
            )
            vertex = start + (i * side + j) * side + k
            total += (x * y * z)[:, None] * self.vertices.index_select(0, vertex)
        total[:, 0] = total[:, 0] * self.scale + self.low
        return total

    def _colour(self, h: torch.Tensor, harmonics: torch.Tensor) -> torch.Tensor:
        del harmonics
        value = h[:, 1:] / 255
        bright = ((value.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
        return torch.where(value <= 0.04045, value / 12.92, bright)
