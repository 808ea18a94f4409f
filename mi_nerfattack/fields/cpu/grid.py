"""A hash grid laid out for kernels on a CPU."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
from drjit.hashgrid import HashGridEncoding

from mi_nerfattack.fields.cpu.words import AbstractWords, pack_words

_PRIMES = (1, 2654435761, 805459861)
_CORNERS = [(i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]


class PackedGrid:
    """A copy of a hash grid's table, two features in a word.

    `HashGridEncoding` gathers feature by feature, and a kernel moves most of its
    intermediate results through memory. Here a vertex takes one gather for every two
    features, and each level is a block of its own, so that a few numbers are in use at
    a time. The features are those of the encoding but for rounding; there are no
    derivatives.

    Args:
        encoding: three-dimensional, aligned corners, an even number of features a
            vertex; tables of hashed levels hold a power of two of vertices.

    Attributes:
        table: the copy, n_params / 2 words.
    """

    def __init__(self, encoding: HashGridEncoding) -> None:
        self._levels = [_Level(encoding, k) for k in range(encoding.n_levels)]
        self._words = encoding.n_features_per_level // 2
        self.table: AbstractWords = pack_words(dr.detach(encoding.data).numpy())

    def encode(self, unit: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        """Evaluate the features at points.

        Args:
            unit: (3, n), positions in [0, 1).
            active: (n,) mask; other points have features 0.

        Returns:
            `n_output_features` times (n,).
        """
        result: list[mi.Float] = []
        for level in self._levels:
            index, weights = level.corners(unit, self.table.scale)
            result += _mix(self.table, self._words, index, weights, active)
        return result


class _Level:
    """Where one level of a hash grid has its vertices."""

    def __init__(self, encoding: HashGridEncoding, level: int) -> None:
        self.scale = encoding._level_scale(level)
        self.resolution = encoding._resolution(self.scale)
        self.offset = encoding.level_offset(level)
        self.size = encoding.level_offset(level + 1) - self.offset
        self.dense = self.resolution**3 <= self.size

    def corners(
        self, unit: mi.Point3f, scale: float
    ) -> tuple[list[mi.UInt32], list[mi.Float]]:
        """Return vertices and weights times `scale` of the eight corners."""
        cell = [x * self.scale for x in unit]
        lower = [dr.floor(x) for x in cell]
        upper = [x - y for x, y in zip(cell, lower, strict=True)]
        x, y, z = [(1 - w, w) for w in upper]
        z = z[0] * scale, z[1] * scale
        weights = [x[i] * (y[j] * z[k]) for i, j, k in _CORNERS]
        return self._vertices([mi.UInt32(mi.Int32(x)) for x in lower]), weights

    def _vertices(self, cell: Sequence[mi.UInt32]) -> list[mi.UInt32]:
        n = self.resolution
        stride = (1, n, n * n) if self.dense else _PRIMES
        low = [c * s for c, s in zip(cell, stride, strict=True)]
        # the next multiple by addition: products of 32 bits are slow
        x, y, z = [(a, a + mi.UInt32(s)) for a, s in zip(low, stride, strict=True)]
        if self.dense:
            return [x[i] + (y[j] + z[k]) + self.offset for i, j, k in _CORNERS]
        mask = self.size - 1
        return [((x[i] ^ (y[j] ^ z[k])) & mask) + self.offset for i, j, k in _CORNERS]


def _mix(
    table: AbstractWords,
    words: int,
    index: list[mi.UInt32],
    weights: list[mi.Float],
    active: mi.Bool,
) -> list[mi.Float]:
    result = [mi.Float(0) for _ in range(2 * words)]
    for vertex, weight in zip(index, weights, strict=True):
        for k in range(words):
            pair = table.gather(vertex * words + k, active)
            for j, value in enumerate(pair, 2 * k):
                result[j] = dr.fma(weight, value, result[j])
    return result
