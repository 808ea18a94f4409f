"""States and controls of vehicles in double precision."""

from __future__ import annotations

import drjit as dr
import numpy as np


def row64(values):
    """Upload (n,); a list, as the alignment of NumPy's memory is part of a kernel."""
    return dr.llvm.ad.Float64(np.asarray(values, float).tolist())


def state64(values):
    """Upload (m, n)."""
    rows = [row64(row) for row in values]
    return (dr.llvm.ad.Array3f64 if len(rows) == 3 else dr.llvm.ad.ArrayXf64)(*rows)
