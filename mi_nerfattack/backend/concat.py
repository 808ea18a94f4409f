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
    result, start = _empty(parts[0], sum(counts)), 0
    for part, count in zip(parts, counts, strict=True):
        _put(result, part, dr.opaque(index, start) + dr.arange(index, count))
        dr.eval(result)  # of parts of equal size it would make one kernel
        start += count
    return result


def split(array: Any, count: int) -> list[Any]:
    """Cut an array (n count,) into n of `count` entries, evaluated."""
    index = dr.uint32_array_t(array)
    within = dr.arange(index, count)
    starts = range(0, dr.width(array), count)
    parts = []
    for start in starts:
        place = dr.opaque(index, start) + within
        parts.append(dr.gather(type(array), array, place))
        dr.eval(parts[-1])  # see `concat`
    return parts


def _empty(part: Any, size: int) -> Any:
    if isinstance(part, list):
        return [_empty(item, size) for item in part]
    if is_dataclass(part):
        values = {f.name: _empty(getattr(part, f.name), size) for f in fields(part)}
        return type(part)(**values)
    return dr.empty(type(part), size) if dr.is_array_v(part) else part


def _put(target: Any, part: Any, place: Any) -> None:
    if isinstance(part, list):
        for item, value in zip(target, part, strict=True):
            _put(item, value, place)
    elif is_dataclass(part):
        for name in (item.name for item in fields(part)):
            _put(getattr(target, name), getattr(part, name), place)
    elif dr.is_array_v(part):
        dr.scatter(target, part, place)


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
