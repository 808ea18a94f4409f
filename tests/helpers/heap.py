"""Which blocks glibc maps by themselves, read off their sizes: whole pages."""

from __future__ import annotations

import ctypes
import mmap
import platform

GLIBC = platform.libc_ver()[0] == "glibc"
#: Variables by which a user sets the threshold.
OWN = ("MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


def is_mapped() -> bool:
    """Tell whether 100 kB are, once the heap has no room left.

    glibc's own threshold starts at 128 KiB.
    """
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    libc.malloc_usable_size.restype = ctypes.c_size_t
    size = ctypes.c_size_t(100_000)
    blocks = [ctypes.c_void_p(libc.malloc(size)) for _ in range(200)]
    usable = [libc.malloc_usable_size(block) for block in blocks]
    for block in blocks:
        libc.free(block)
    return any((size + 16) % mmap.PAGESIZE == 0 for size in usable)  # with its head
