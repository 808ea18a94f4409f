"""The C library's heap."""

from __future__ import annotations

import ctypes
import platform
from functools import cache
from typing import Any


def release_heap() -> bool:
    """Give pages of the heap that hold nothing back to the system, in a millisecond.

    glibc keeps torch's buffers in its heap, between small blocks that live on: free
    pages then add up with the length of a drive. Other C libraries are left alone.

    Returns:
        whether there were any.
    """
    trim = _trim()
    return trim is not None and trim(0) == 1


@cache
def _trim() -> Any:
    """Return glibc's ``malloc_trim``, or None."""
    if platform.libc_ver()[0] != "glibc":
        return None
    return ctypes.CDLL(None).malloc_trim
