"""The C library's heap."""

from __future__ import annotations

import ctypes
import os
import platform

_LEAST_MAPPED = 64 << 10  # bytes
_M_MMAP_THRESHOLD = -3  # of <malloc.h>


def map_large_blocks() -> bool:
    """Let glibc map each block of 64 KiB and more by itself, in this process.

    What is mapped goes back to the system when it is freed. Otherwise glibc raises its
    threshold up to 32 MiB as blocks are freed: torch's buffers then lie in the heap,
    between small blocks that live on, and the heap grows with the length of a drive.

    Left alone are other C libraries and a threshold of the user's, in
    ``MALLOC_MMAP_THRESHOLD_`` or ``GLIBC_TUNABLES``.

    Returns:
        whether it is so by this call.
    """
    own = "MALLOC_MMAP_THRESHOLD_" in os.environ
    own |= "glibc.malloc.mmap_threshold=" in os.environ.get("GLIBC_TUNABLES", "")
    if own or platform.libc_ver()[0] != "glibc":
        return False
    return ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LEAST_MAPPED) == 1
