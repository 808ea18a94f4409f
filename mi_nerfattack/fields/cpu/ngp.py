"""An NGP laid out for marches on a CPU whose parameters are constants."""

from __future__ import annotations

import hashlib
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.cpu.grid import PackedGrid
from mi_nerfattack.fields.cpu.networks import networks
from mi_nerfattack.fields.ngp import NGPField

#: More would take a compiler too long.
MAX_WEIGHTS = 1 << 14


class PackedNGP:
    """A copy of an NGP's parameters with less to do at a sample.

    The last layer of the density network and the first of the colour network are
    linear: they become one matrix. The contribution of the view to that layer is
    computed once per ray. Weights are literals of the kernel, so that sums stay in
    registers. Dr.Jit's products with matrices in memory keep the sums in memory, and
    the march takes 1.4 times as long. A kernel is good for one set of weights;
    compiling it takes 1 s for 3,300 weights and 4 s for 11,000. Values are those of
    :meth:`NGPField.eval` except for rounding.

    Args:
        field: the field, on the LLVM backend; see :meth:`suits`.

    Attributes:
        digest: SHA-256 of the weights, which identifies them.
    """

    def __init__(self, field: NGPField) -> None:
        self._field = field
        self._source = _identities(field)
        self._grid = PackedGrid(field.encoding)
        host = networks(field)
        *hidden, last = host.density.weights
        first, *layers = host.colour.weights
        split = len(last)
        joined = first[:, :split].astype(np.float64) @ last
        self._hidden, self._view, self._layers = hidden, first[:, split:], layers
        self._joined = np.vstack([last[:1], joined]).astype(np.float32)
        matrices = (*hidden, self._joined, self._view, *layers)
        packed = b"".join(np.ascontiguousarray(part).tobytes() for part in matrices)
        self.digest: str = hashlib.sha256(packed).hexdigest()

    @staticmethod
    def suits(field: NGPField) -> bool:
        """Tell fields with an even number of features and not too many weights."""
        weights = field.density_net["weights"], field.colour_net["weights"]
        count = sum(dr.width(value) for value in weights)
        return field.layout.features % 2 == 0 and count <= MAX_WEIGHTS

    def is_current(self) -> bool:
        """Tell whether the field's parameters are those that were copied."""
        pairs = zip(self._source, _identities(self._field), strict=True)
        return all(a.index == b.index for a, b in pairs)

    def state(self) -> list[Any]:
        """Return what :meth:`eval` reads or was compiled for, for `drjit.freeze`."""
        return [self._grid.table.array, self.digest]

    def view(self, heading: mi.Vector3f) -> list[mi.Float]:
        """Return what directions add to the first layer of the colour network.

        Args:
            heading: (3, n), unit vectors in the field's frame.

        Returns:
            (n,) for each neuron.
        """
        harmonics = dr.sh_eval(mi.Vector3f(heading), self._field.sh_order)
        return _product(self._view, [mi.Float(x) for x in harmonics])

    def eval(
        self, point: mi.Point3f, view: list[mi.Float], active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """Evaluate density and radiance; as :meth:`NGPField.eval`.

        Args:
            point: (3, n), metres in the field's frame.
            view: from :meth:`view`.
            active: (n,) mask; masked lanes give zeros.
        """
        x = self._grid.encode(self._field.clipped(point), active)
        for weight in self._hidden:
            x = _rectify(_product(weight, x))
        raw_density, *x = _product(self._joined, x)
        pairs = zip(x, view, strict=True)
        x = [a + b for a, b in pairs]
        for weight in self._layers:
            x = _product(weight, _rectify(x))
        density, colour = self._field.activate(raw_density, x)
        density *= self._field.window(self._field.unit(point), active)
        return density & active, colour & active


def _product(matrix: np.ndarray, x: list[mi.Float]) -> list[mi.Float]:
    """Return the products of rows with x, each weight a literal."""
    result = []
    for row in matrix.tolist():
        value = mi.Float(0)
        for weight, entry in zip(row, x, strict=True):
            value = dr.fma(entry, weight, value)
        result.append(value)
    return result


def _rectify(x: list[mi.Float]) -> list[mi.Float]:
    return [dr.maximum(value, 0) for value in x]


def _identities(field: NGPField) -> list[Any]:
    """Return the arrays themselves: an array that is held keeps its index."""
    return [dr.detach(field.parameters()[k]) for k in _COPIED]


_COPIED = ("table", "density_weights", "colour_weights")
