"""Arrays from NumPy whose kernels do not depend on where NumPy put them.

Memory from NumPy has an alignment of its own, and Dr.Jit compiles kernels of its own
for that; lists have none. On a CPU, Dr.Jit does not copy NumPy's memory, either: who
changes an array afterwards changes what kernels read, and while a frozen function is
recorded, giving such memory back ends the process.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


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
