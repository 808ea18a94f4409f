"""Arrays end to end, and from NumPy, by kernels that do not depend on places in memory.

`drjit.concat` and slices compile a kernel for every offset. Memory from NumPy has an
alignment of its own, and Dr.Jit compiles kernels of its own for that; lists have none.
On a CPU, Dr.Jit does not copy NumPy's memory, either: who changes an array afterwards
changes what kernels read, and while a frozen function is recorded, giving such memory
back ends the process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def concat(parts: Sequence[Any], counts: Sequence[int]) -> Any:
    """Lay arrays, or dataclasses and lists of arrays, end to end.

    Args:
        parts: alike; an array may have one entry that stands for all of its part. What
            is no array is the same in all parts.
        counts: size of each part.

    Returns:
        evaluated arrays of the sum of the sizes.
    """
    result, start = _empty(parts[0], sum(counts)), 0
    for part, count in zip(parts, counts, strict=True):
        put(result, part, dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, count))
        dr.eval(result)  # of parts of equal size it would make one kernel
        start += count
    return result


def split(array: Any, count: int) -> list[Any]:
    """Cut an array (n count,) into n of `count` entries, evaluated."""
    within = dr.arange(mi.UInt32, count)
    starts = range(0, dr.width(array), count)
    parts = []
    for start in starts:
        place = dr.opaque(mi.UInt32, start) + within
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


def put(target: Any, part: Any, place: mi.UInt32) -> None:
    """Scatter arrays, or dataclasses and lists of arrays, leaf by leaf.

    Args:
        target: of arrays to scatter into.
        part: likewise, to scatter.
        place: entry k goes to `place[k]`.
    """
    if isinstance(part, list):
        for item, value in zip(target, part, strict=True):
            put(item, value, place)
    elif is_dataclass(part):
        for name in (item.name for item in fields(part)):
            put(getattr(target, name), getattr(part, name), place)
    elif dr.is_array_v(part):
        dr.scatter(target, part, place)


def upload(kind: Any, values: np.ndarray) -> Any:
    """Copy an array to a flat one of a type, such as `mi.Float`, in Dr.Jit's memory.

    Args:
        kind: a Dr.Jit type of one dimension.
        values: of any shape; numbers are converted to those of `kind`.
    """
    number = np.dtype(dr.type_v(kind).name.lower())
    # the kernel runs later, so that NumPy has to copy, too
    borrowed = kind(np.array(values, number).reshape(-1))
    result = dr.empty(kind, values.size)
    # a gather of everything, or `dr.copy`, would return the same memory
    dr.scatter(result, borrowed, dr.arange(dr.uint32_array_t(kind), values.size))
    dr.eval(result)
    return result


def upload_rows(kind: Any, rows: np.ndarray) -> Any:
    """Return vectors of a type, such as `mi.Point3f`, from rows (n, m)."""
    column = dr.value_t(kind)
    return kind(*[column(values) for values in rows.T.tolist()])
