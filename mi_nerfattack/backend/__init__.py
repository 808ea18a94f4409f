"""Dr.Jit and its LLVM: variants, versions, determinism, recordings, arrays of torch."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .determinism import deterministic as deterministic
    from .threads import one_thread as one_thread
    from .variant import ensure as ensure

__getattr__, __dir__ = lazy(__name__)
