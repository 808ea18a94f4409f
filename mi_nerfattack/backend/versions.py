"""The versions that a result depends on."""

from __future__ import annotations

import functools
import importlib.metadata

import drjit as dr
import mitsuba as mi

import mi_nerfattack
from mi_nerfattack.backend import llvm


def versions() -> dict[str, str]:
    """Return the versions that a result depends on, with the active variant."""
    return {
        "mi_nerfattack": mi_nerfattack.__version__,
        "mitsuba": str(mi.__version__),
        "drjit": str(dr.__version__),
        "numpy": _installed("numpy"),
        "torch": _installed("torch"),
        "llvm": ".".join(map(str, llvm.version() or ())),
        "variant": str(mi.variant()),
    }


@functools.cache
def _installed(package: str) -> str:
    return importlib.metadata.version(package)
