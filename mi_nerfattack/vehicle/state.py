"""States of vehicles as Dr.Jit arrays."""

from __future__ import annotations

import sys
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload_rows


def state_type(size: int = 3) -> Any:
    """Type of a batch of states of `size` rows, of the active variant, double."""
    if size == 3:
        return dr.float64_array_t(mi.Vector3f)
    return sys.modules[mi.Float.__module__].ArrayXf64


def to_state(states: np.ndarray) -> Any:
    """Upload states (n, m), metres and radians first, as an opaque (m, n) array.

    Raises:
        ValueError: another shape, less than three columns, or not finite.
    """
    states = np.atleast_2d(np.asarray(states, np.float64))
    if states.ndim != 2 or states.shape[1] < 3 or not np.isfinite(states).all():
        raise ValueError(f"states: shape {states.shape}; expected finite (n, 3)")
    kind = state_type(states.shape[1])
    result = upload_rows(kind, states)
    dr.make_opaque(result)
    return result
