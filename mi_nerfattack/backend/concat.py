"""Arrays end to end, by kernels that do not depend on where one of them ends.

`drjit.concat` and slices compile a kernel for every offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import drjit as dr


def concat(parts: Sequence[Any], counts: Sequence[int]) -> Any:
    """Lay arrays, or dataclasses and lists of arrays, end to end.

    Args:
        parts: alike; an array may have one entry that stands for all of its part. What
            is no array is the same in all parts.
        counts: size of each part.

    Returns:
        evaluated arrays of the sum of the sizes.
    """
    index = _index_type(parts[0])
    places, start = [], 0
    for count in counts:
        places.append(dr.opaque(index, start) + dr.arange(index, count))
        start += count
    result = _lay(parts, places, start)
    dr.eval(result)
    return result


def split(array: Any, count: int) -> list[Any]:
    """Cut an array (n count,) into n of `count` entries, evaluated."""
    index = dr.uint32_array_t(array)
    within = dr.arange(index, count)
    starts = range(0, dr.width(array), count)
    parts = [
        dr.gather(type(array), array, dr.opaque(index, start) + within)
        for start in starts
    ]
    dr.eval(parts)
    return parts


def _lay(parts: Sequence[Any], places: Sequence[Any], total: int) -> Any:
    first = parts[0]
    if isinstance(first, list):
        return [_lay(items, places, total) for items in zip(*parts, strict=True)]
    if is_dataclass(first):
        names = [item.name for item in fields(first)]
        values = {k: _lay([getattr(p, k) for p in parts], places, total) for k in names}
        return type(first)(**values)
    if not dr.is_array_v(first):
        return first
    target = dr.empty(type(first), total)
    for part, place in zip(parts, places, strict=True):
        dr.scatter(target, part, place)
    return target


def _index_type(part: Any) -> Any:
    """Return the type of indices for the arrays of a part."""
    if isinstance(part, list):
        return _index_type(part[0])
    if is_dataclass(part):
        return _index_type(getattr(part, fields(part)[0].name))
    kind = type(part)
    while dr.depth_v(kind) > 1:
        kind = dr.value_t(kind)
    return dr.uint32_array_t(kind)
