"""An NGP's networks as products of matrices over many points at a time.

On a CPU a kernel that differentiates the networks point by point adds each point's
part to every weight by an atomic operation, which takes most of its time. As products
of matrices the derivatives by the weights are products again.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import drjit.nn as nn
import mitsuba as mi


def matrices(net: nn.Module) -> list[Any]:
    """Return the matrices of a packed network as tensors, detached from it."""
    result = []
    for layer in net.layers:
        if isinstance(layer, nn.Linear):
            view = layer.weights
            index = view.offset + dr.arange(mi.UInt32, view.size)
            flat = dr.gather(mi.Float, dr.detach(view.buffer), index)
            result.append(mi.TensorXf(flat, view.shape))
    return result


def add_gradient(net: nn.Module, own: list[Any]) -> None:
    """Add the gradients of `matrices(net)` to those of the packed weights."""
    parts = [dr.grad(matrix).array for matrix in own]
    dr.accum_grad(net["weights"], dr.concat(parts))


def apply(own: list[Any], rows: Any) -> Any:
    """Apply linear layers with rectifiers between them to (n, k) rows."""
    for matrix in own[:-1]:
        rows = dr.maximum(dr.matmul(rows, matrix, Bt=True), 0)
    return dr.matmul(rows, own[-1], Bt=True)


def column(rows: Any, k: int) -> mi.Float:
    """Read a column of (n, width) rows; no two lanes share an entry."""
    height, width = rows.shape
    index = k + width * dr.arange(mi.UInt32, height)
    mode = dr.ReduceMode.NoConflicts
    return dr.gather(mi.Float, rows.array, index, mode=mode)


def lay_out(values: Any) -> mi.Float:
    """Lay k arrays (n,) out row by row, (n k,)."""
    columns = mi.ArrayXf([mi.Float(value) for value in values])
    count = dr.width(columns)
    flat = dr.zeros(mi.Float, count * len(columns))
    dr.scatter(flat, columns, dr.arange(mi.UInt32, count))
    return flat


def some_rows(flat: mi.Float, first: mi.UInt32, height: int, width: int) -> Any:
    """Copy rows; their place is not compiled into the kernel."""
    index = first * width + dr.arange(mi.UInt32, height * width)
    return mi.TensorXf(dr.gather(mi.Float, flat, index), (height, width))
