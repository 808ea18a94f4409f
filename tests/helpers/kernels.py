"""What Dr.Jit launches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr


@contextmanager
def nothing_compiled() -> Iterator[None]:
    """Fail unless kernels are launched within, all of which are known."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield
        history = dr.kernel_history((dr.KernelType.JIT,))
    assert history and all(kernel["cache_hit"] for kernel in history)
