"""The two networks of an NGP over many points, as products of matrices on a CPU.

A kernel that differentiates the networks point by point adds each point's part to
every weight by an atomic operation, which takes most of its time. As products of
matrices the derivatives by the weights are products again, and NumPy's library for
these (BLAS) is two to three times faster than Dr.Jit's.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np
from threadpoolctl import ThreadpoolController

from mi_nerfattack.system.machine import cores

if TYPE_CHECKING:
    from mi_nerfattack.fields.ngp import NGPField


BLOCK = 1 << 12  # points whose activations exist side by side, in a cache


@dataclass(frozen=True)
class MLP:
    """Linear layers without bias, with rectifiers between them.

    Attributes:
        weights: a matrix (outputs, inputs) for each layer, float32.
    """

    weights: list[np.ndarray]

    def forward(self, x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the outputs for rows x (n, inputs), and the inputs of each layer."""
        inputs = [x]
        for weight in self.weights[:-1]:
            x = x @ weight.T
            np.maximum(x, 0, out=x)
            inputs.append(x)
        return x @ self.weights[-1].T, inputs

    def backward(
        self, inputs: list[np.ndarray], slope: np.ndarray
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return derivatives by x (n, inputs) and by each weight.

        Args:
            inputs: from :meth:`forward`.
            slope: (n, outputs), derivative of an objective by the outputs.
        """
        by_weight = []
        for k in range(len(self.weights) - 1, -1, -1):
            by_weight.append(slope.T @ inputs[k])
            slope = slope @ self.weights[k]
            if k:
                slope *= inputs[k] > 0
        return slope, by_weight[::-1]


class Networks:
    """Density and colour network over rows, block by block on all cores.

    Results do not depend on the number of cores.

    Args:
        density: from features to geometry, whose first entry is the raw density.
        colour: from geometry and view to raw colours.
    """

    def __init__(self, density: MLP, colour: MLP) -> None:
        self.density, self.colour = density, colour
        self._layer_inputs: list[tuple[list[np.ndarray], list[np.ndarray]]] = []

    def raw_density(self, features: np.ndarray, out: np.ndarray) -> None:
        """Evaluate the raw density alone.

        Args:
            features: (n, k).
            out: (n,), is filled.
        """
        *hidden, last = self.density.weights
        first = MLP([*hidden, last[:1]])

        def work(part: slice) -> None:
            out[part] = first.forward(features[part])[0][:, 0]

        _each(work, len(features))

    def forward(self, features: np.ndarray, view: np.ndarray, out: np.ndarray) -> None:
        """Evaluate, and keep what :meth:`backward` needs.

        Args:
            features: (n, k), of the encoding.
            view: (n, m), of the directions.
            out: (n, 4), is filled with raw density and raw colours.
        """

        def work(part: slice) -> tuple[list[np.ndarray], list[np.ndarray]]:
            geometry, first = self.density.forward(features[part])
            joined = np.concatenate([geometry, view[part]], axis=1)
            raw, second = self.colour.forward(joined)
            out[part, 0], out[part, 1:] = geometry[:, 0], raw
            return first, second

        self._layer_inputs = _each(work, len(features))

    def backward(
        self, slope: np.ndarray, out: np.ndarray
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Differentiate what the last :meth:`forward` gave.

        Args:
            slope: (n, 4), derivative of an objective by the outputs.
            out: (n, k), is filled with the derivative by the features.

        Returns:
            the derivatives by the weights of the density and of the colour network.
        """
        outputs = self.density.weights[-1].shape[0]

        def work(part: slice) -> list[np.ndarray]:
            first, second = self._layer_inputs[part.start // BLOCK]
            joined, by_colour = self.colour.backward(second, slope[part, 1:])
            geometry = joined[:, :outputs]
            geometry[:, 0] += slope[part, 0]
            out[part], by_density = self.density.backward(first, geometry)
            return by_density + by_colour

        blocks = _each(work, len(slope))
        self._layer_inputs = []
        total = [np.sum(by_block, axis=0) for by_block in zip(*blocks, strict=True)]
        split = len(self.density.weights)
        return total[:split], total[split:]


def _each(work: Callable[[slice], Any], count: int) -> list[Any]:
    """Do work on blocks of rows, and return the results in order."""
    slices = (slice(s, min(s + BLOCK, count)) for s in range(0, count, BLOCK))
    if not _WORKERS:
        pool = ThreadPoolExecutor(cores())
        _WORKERS.append((pool, ThreadpoolController()))
    pool, libraries = _WORKERS[0]
    # products this small are faster side by side than each on several threads
    with libraries.limit(limits=1, user_api="blas"):
        return list(pool.map(work, slices))


_WORKERS: list[tuple[ThreadPoolExecutor, ThreadpoolController]] = []


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
    for net, gradients in zip(nets, by_weight, strict=True):
        if dr.grad_enabled(net["weights"]):
            flat = np.concatenate([gradient.ravel() for gradient in gradients])
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
    by_feature = columns(slopes, len(features))
    products = (feature * by_feature[k] for k, feature in enumerate(features))
    dr.backward_from(sum(products, mi.Float(0)))


def _matrices(net: nn.Module) -> list[np.ndarray]:
    result = []
    for layer in net.layers:
        if isinstance(layer, nn.Linear):
            view = layer.weights
            flat = dr.detach(view.buffer).numpy()
            part = flat[view.offset : view.offset + view.size]
            result.append(part.reshape(view.shape).astype(np.float32))
    return result
