"""Tables of pairs of numbers, packed into words that a kernel gathers at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.upload import upload

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
    kept = bits & np.uint32(_SIGN | _MAGNITUDE)
    if not np.array_equal(kept.view(np.float32) * np.float32(1 / _BIAS), values):
        return None
    sign = (kept >> np.uint32(16)) & np.uint32(0x8000)
    return (sign | (kept & np.uint32(_MAGNITUDE)) >> np.uint32(13)).astype(np.uint16)
