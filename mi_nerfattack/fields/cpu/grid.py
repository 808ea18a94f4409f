"""A hash grid as a table of words: pairs of numbers that a kernel gathers at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.hashgrid import HashGridEncoding

from mi_nerfattack.backend.arrays import upload

_BIAS = 2.0**-102  # takes 2^-24 to the smallest normal number of single precision
_SIGN, _MAGNITUDE = 1 << 31, 0x7FFF << 13


class AbstractWords(ABC):
    """A table of pairs.

    Attributes:
        array: (n,), one word a pair.
        scale: what numbers from :meth:`gather` must be multiplied with.
    """

    array: Any
    scale: float

    @abstractmethod
    def gather(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return pairs, divided by `scale`; zeros where masked.

        Args:
            index: (m,) of the pairs.
            active: (m,) mask.
        """


def pack_words(values: np.ndarray) -> AbstractWords:
    """Pack numbers without loss into the shortest words that hold them.

    Args:
        values: (2 n,), single precision.
    """
    short = _shorten(values)
    return LongWords(values) if short is None else ShortWords(short)


class LongWords(AbstractWords):
    """Two numbers of single precision in 64 bits.

    Args:
        values: (2 n,).
    """

    scale = 1.0

    def __init__(self, values: np.ndarray) -> None:
        self.array = upload(mi.UInt64, values.view("<u8"))
        dr.make_opaque(self.array)

    def gather(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """See :meth:`AbstractWords.gather`."""
        word = dr.gather(mi.UInt64, self.array, index, active)
        return _float(mi.UInt32(word)), _float(mi.UInt32(word >> 32))


class ShortWords(AbstractWords):
    """Two numbers in 32 bits: those of half precision below 128, and zero.

    Of the bits of a number of single precision, divided by `scale`, these are the
    sign and the 15 that differ between such numbers. So they are taken apart by
    shifts, no number is ever subnormal, and `scale` joins the factors that follow.

    Args:
        codes: (2 n,), 16 bits each.
    """

    scale = 1 / _BIAS

    def __init__(self, codes: np.ndarray) -> None:
        self.array = upload(mi.UInt32, codes.view("<u4"))
        dr.make_opaque(self.array)

    def gather(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """See :meth:`AbstractWords.gather`."""
        word = dr.gather(mi.UInt32, self.array, index, active)
        return _spread(word << 16), _spread(word)


def _spread(word: mi.UInt32) -> mi.Float:
    """Turn the upper code of a word into a number; the shift repeats the sign."""
    shifted = dr.reinterpret_array(mi.Int32, word) >> 3
    return _float(dr.reinterpret_array(mi.UInt32, shifted) & (_SIGN | _MAGNITUDE))


def _float(bits: mi.UInt32) -> mi.Float:
    return mi.Float(dr.reinterpret_array(mi.Float, bits))


def _shorten(values: np.ndarray) -> np.ndarray | None:
    """Return the codes (2 n,) of numbers, or None where some have none."""
    size = np.abs(values)
    if ((size > 0) & (size < 2.0**-24)).any():
        return None
    bits = (values * np.float32(_BIAS)).view(np.uint32)
    masked = bits & np.uint32(_SIGN | _MAGNITUDE)
    if not np.array_equal(masked.view(np.float32) * np.float32(1 / _BIAS), values):
        return None
    sign = (masked >> np.uint32(16)) & np.uint32(0x8000)
    return (sign | (masked & np.uint32(_MAGNITUDE)) >> np.uint32(13)).astype(np.uint16)


_PRIMES = (1, 2654435761, 805459861)
_CORNERS = [(i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]


class PackedGrid:
    """A copy of a hash grid's table, two features in a word.

    `HashGridEncoding` gathers feature by feature, and a kernel moves most of its
    intermediate results through memory. Here a vertex takes one gather for every two
    features, and each level is a block of its own, so that a few numbers are in use at
    a time. The features are those of the encoding except for rounding; there are no
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
            result += _mix(
                self.table, self._words, index, weights=weights, active=active
            )
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
