"""Arrays from NumPy whose kernels do not depend on where NumPy put them.

Memory from NumPy has an alignment of its own, and Dr.Jit compiles kernels of its own
for that; lists have none.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def upload_rows(kind: Any, rows: np.ndarray) -> Any:
    """Return vectors of a type, such as `mi.Point3f`, from rows (n, m)."""
    column = dr.value_t(kind)
    return kind(*[column(values) for values in rows.T.tolist()])
