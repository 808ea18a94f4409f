"""The multi-resolution hash encoding in PyTorch: the fastest that we found.

All arithmetic runs along contiguous points; both features of a vertex travel as one
complex number; the derivative is added straight into ``table.grad``. The table is
indexed as `drjit.hashgrid.HashGridEncoding` with aligned corners does: a level is dense
where all its vertices fit into the table, otherwise hashed with the primes of
tiny-cuda-nn. Source: Mueller et al. 2022, section 3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from bench.ngp_data import PRIMES, level_sizes
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.ngp import NGPLayout


class HashGrid:
    """Hash encoding of points; the table itself is an argument.

    Args:
        layout: levels, of two features a vertex, and the size of the table.
    """

    def __init__(self, layout: NGPLayout) -> None:
        if layout.features != 2:
            raise InputError(f"features: {layout.features}; the peer needs 2")
        self.levels, self.features = layout.levels, layout.features
        sizes = level_sizes(layout)
        slots = np.array([size for _, _, size in sizes])
        self.rows = int(slots.sum())
        self.dense = sum(edge**3 <= size for _, edge, size in sizes)
        factors = [
            (1, edge, edge * edge) if level < self.dense else PRIMES
            for level, (_, edge, _) in enumerate(sizes)
        ]
        wrapped = np.array(factors, np.uint32).view(np.int32)  # of equal low bits
        self.factors = torch.as_tensor(wrapped)
        self.scale = torch.tensor([scale for scale, _, _ in sizes])
        self.first = torch.tensor(np.cumsum(slots) - slots, dtype=torch.int32)
        self.mask = torch.tensor(slots - 1, dtype=torch.int32)

    def __call__(self, table: torch.Tensor, unit: torch.Tensor) -> torch.Tensor:
        """Encode points.

        Args:
            table: (rows, features).
            unit: (n, 3), in [0, 1); no derivative is taken by it.

        Returns:
            (n, levels * features), differentiable by the table.
        """
        index, weight = self._corners(unit.T.contiguous())
        features = _GatherSum.apply(table, index, weight)
        return features.permute(1, 0, 2).reshape(len(unit), -1)

    def _corners(self, unit: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows of the table and weights, each (levels, 8, n)."""
        place = unit * self.scale[:, None, None]  # (levels, 3, n)
        low = place.floor()
        part = place - low
        weight = torch.stack([1 - part, part], 1)  # (levels, 2, 3, n)
        key = low.to(torch.int32).mul_(self.factors[:, :, None])
        key = torch.stack([key, key + self.factors[:, :, None]], 1)
        x, y, z = (key[:, None, None, :, 0], key[:, None, :, 1], key[:, :, 2])
        y, z = y[:, :, :, None], z[:, :, None, None]
        n, count = self.dense, unit.shape[1]
        index = torch.empty((self.levels, 2, 2, 2, count), dtype=torch.int32)
        torch.add(z[:n] + y[:n], x[:n], out=index[:n])
        torch.bitwise_xor(z[n:] ^ y[n:], x[n:], out=index[n:])
        index[n:] &= self.mask[n:, None, None, None, None]
        index += self.first[:, None, None, None, None]
        u, v, w = (weight[:, None, None, :, 0], weight[:, None, :, 1], weight[:, :, 2])
        weight = (w[:, :, None, None] * v[:, :, :, None]) * u
        return index.reshape(-1, 8, count), weight.reshape(-1, 8, count)


class _GatherSum(torch.autograd.Function):
    """Weighted sum of eight rows of the table."""

    @staticmethod
    def forward(
        ctx: Any, table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor
    ) -> torch.Tensor:
        pairs = torch.view_as_complex(table.detach())
        values = torch.view_as_real(pairs.index_select(0, index.reshape(-1)))
        values = values.reshape(*index.shape, 2)
        total = values[:, 0] * weight[:, 0, :, None]
        for corner in range(1, 8):
            total.addcmul_(values[:, corner], weight[:, corner, :, None])
        ctx.table = table
        ctx.save_for_backward(index, weight)
        return total

    @staticmethod
    def backward(ctx: Any, *grad_outputs: torch.Tensor) -> tuple[None, None, None]:
        index, weight = ctx.saved_tensors
        table = ctx.table
        if table.grad is None:
            table.grad = torch.zeros_like(table)
        values = grad_outputs[0][:, None] * weight[..., None]
        torch.view_as_complex(table.grad).scatter_add_(
            0, index.reshape(-1).long(), torch.view_as_complex(values).reshape(-1)
        )
        return None, None, None
