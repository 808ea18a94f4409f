"""States and controls of vehicles in double precision."""

from __future__ import annotations

import drjit as dr
import numpy as np


def rows64(values):
    return [dr.llvm.ad.Float64(item) for item in np.asarray(values, float).tolist()]


def state64(values):
    rows = rows64(values)
    return (dr.llvm.ad.Array3f64 if len(rows) == 3 else dr.llvm.ad.ArrayXf64)(*rows)
