"""An NGP's networks on the host, and arrays that Dr.Jit and NumPy share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.cpu.matrices import MLP, Networks

if TYPE_CHECKING:
    from mi_nerfattack.fields.ngp import NGPField


class SharedRows:
    """A Dr.Jit array on a CPU and NumPy's view of its memory.

    Args:
        height: number of rows.
        width: values in a row.

    Attributes:
        array: (height width,).
        view: (height, width).
    """

    def __init__(self, height: int, width: int) -> None:
        self.array = dr.zeros(mi.Float, height * width)
        dr.make_opaque(self.array)
        dr.sync_thread()
        self.view: np.ndarray = rows(self.array, width)


def rows(values: mi.Float, width: int) -> np.ndarray:
    """View an array on a CPU row by row, once it is computed, (n, width)."""
    return values.numpy().reshape(-1, width)


def lay_out(values: Any) -> mi.Float:
    """Lay k arrays (n,) out row by row, (n k,)."""
    columns = mi.ArrayXf([mi.Float(value) for value in values])  # pyright: ignore[reportCallIssue]
    count = dr.width(columns)
    flat = dr.zeros(mi.Float, count * len(columns))
    dr.scatter(flat, columns, dr.arange(mi.UInt32, count))
    return flat


def columns(flat: mi.Float, width: int) -> Any:
    """Take rows (n, width) apart; no two lanes share an entry."""
    count = dr.width(flat) // width
    index = dr.arange(mi.UInt32, count)
    mode = dr.ReduceMode.NoConflicts
    return dr.gather(mi.ArrayXf, flat, index, shape=(width, count), mode=mode)


def networks(field: NGPField) -> Networks:
    """Copy the networks of a field to the host."""
    nets = (field.density_net, field.colour_net)
    return Networks(*(MLP(_matrices(net)) for net in nets))


def add_gradients(
    field: NGPField, by_weight: tuple[list[np.ndarray], list[np.ndarray]]
) -> None:
    """Add derivatives to the gradients of those weights that ask for them.

    Args:
        field: the field.
        by_weight: from `Networks.backward`.
    """
    nets = (field.density_net, field.colour_net)
    for net, parts in zip(nets, by_weight, strict=True):
        if dr.grad_enabled(net["weights"]):
            flat = np.concatenate([part.ravel() for part in parts])
            # not from NumPy memory, whose alignment would select one of two kernels
            dr.accum_grad(net["weights"], mi.Float(flat.tolist()))


def scatter(field: NGPField, point: mi.Point3f, slopes: mi.Float) -> None:
    """Differentiate the encoding, given the derivatives by its features.

    Args:
        field: the field.
        point: (3, n), where the encoding is looked up, in the field's frame.
        slopes: (n k,), row by row.
    """
    features = [mi.Float(x) for x in field.encoding(field.clipped(point))]
    given = columns(slopes, len(features))
    parts = (feature * given[k] for k, feature in enumerate(features))
    dr.backward_from(sum(parts, mi.Float(0)))


def _matrices(net: nn.Module) -> list[np.ndarray]:
    result = []
    for layer in net.layers:
        if isinstance(layer, nn.Linear):
            view = layer.weights
            flat = dr.detach(view.buffer).numpy()
            part = flat[view.offset : view.offset + view.size]
            result.append(part.reshape(view.shape).astype(np.float32))
    return result
