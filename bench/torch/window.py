"""A field's window in PyTorch: what makes its density fall to 0 in empty cells."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from scipy import ndimage


class TorchWindow:
    """See `mi_nerfattack.fields.occupancy.Window`; a byte a vertex of half cells.

    Args:
        cells: boolean (rx, ry, rz), the occupancy.

    Attributes:
        is_open: whether no cell is empty.
    """

    def __init__(self, cells: np.ndarray) -> None:
        self.is_open = bool(cells.all())
        halves = np.pad(cells, 1, constant_values=self.is_open)
        for axis in range(3):
            halves = np.repeat(halves, 2, axis)
        least = ndimage.minimum_filter(halves, 2)[2:-1, 2:-1, 2:-1]
        self._vertices = torch.as_tensor(least.astype(np.uint8).ravel())
        self._shape = least.shape

    def __call__(self, unit: torch.Tensor) -> torch.Tensor:
        """Return the factor (n,) at positions (n, 3) in the unit box."""
        edges = torch.tensor(self._shape) - 1
        place = unit * edges
        low = torch.minimum(place.floor(), edges - 1)
        part, low = place - low, low.to(torch.int32)
        total = torch.zeros(len(unit))
        _, ry, rz = self._shape
        for i, j, k in itertools.product((0, 1), repeat=3):
            row = ((low[:, 0] + i) * ry + low[:, 1] + j) * rz + low[:, 2] + k
            x, y, z = (
                part[:, axis] if c else 1 - part[:, axis]
                for axis, c in enumerate((i, j, k))
            )
            total += x * y * z * self._vertices.index_select(0, row)
        return (8 * total).clamp(max=1) ** 4
