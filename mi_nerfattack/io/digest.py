"""A digest of arrays, to tell contents apart."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np


def array_digest(arrays: Iterable[np.ndarray]) -> str:
    """Return the SHA-256 of types, shapes and values of arrays, in their order."""
    found = hashlib.sha256()
    for values in arrays:
        found.update(f"{values.dtype} {values.shape}".encode())
        found.update(np.ascontiguousarray(values).data)
    return found.hexdigest()
