"""Pairs of numbers in words: nothing is lost, and short words where they suffice."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.fields.cpu.grid import LongWords, ShortWords, pack_words

pytestmark = pytest.mark.usefixtures("variant")


def read(values: np.ndarray) -> np.ndarray:
    """Pack, gather everything and undo the scale."""
    words = pack_words(values)
    index = dr.arange(mi.UInt32, len(values) // 2)
    pair = words.gather(index, mi.Bool(True))
    dr.eval(pair)
    return np.stack([x.numpy() * np.float32(words.scale) for x in pair], 1).ravel()


def every_half() -> np.ndarray:
    """Return all finite numbers of half precision."""
    values = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    return values[np.isfinite(values)].astype(np.float32)


def test_short_words_hold_every_half_below_128():
    values = every_half()
    values = values[np.abs(values) < 128]
    assert isinstance(pack_words(values), ShortWords)
    np.testing.assert_array_equal(read(values), values)


@pytest.mark.parametrize("odd", [128.0, -128.0, 0.1, 2.0**-25, 1e-42, 3e38])
def test_one_other_number_takes_long_words(odd):
    values = np.array([0.5, 0.25, -1.5, odd], np.float32)
    assert isinstance(pack_words(values), LongWords)
    np.testing.assert_array_equal(read(values), values)


def test_masked_pairs_are_zero():
    for odd in (0.5, 0.1):
        words = pack_words(np.array([odd, 2, 3, 4], np.float32))
        pair = words.gather(mi.UInt32([0, 1]), mi.Bool([False, True]))
        found = np.array(pair) * words.scale
        np.testing.assert_array_equal(found, [[0, 3], [0, 4]])


def test_memory_that_drjit_knows_is_copied():
    values = dr.linspace(mi.Float, 0.1, 0.9, 64)
    dr.eval(values)
    dr.sync_thread()
    np.testing.assert_array_equal(read(values.numpy()), values.numpy())
