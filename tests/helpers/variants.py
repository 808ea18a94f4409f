"""The variants that the plugins support and this machine can run."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

_BACKENDS = ["llvm", "cuda"] if dr.has_backend(dr.JitBackend.CUDA) else ["llvm"]
_NAMES = [f"{backend}_ad_" for backend in _BACKENDS]

MONO = [name + "mono" for name in _NAMES if name + "mono" in mi.variants()]
RGB = [name + "rgb" for name in _NAMES if name + "rgb" in mi.variants()]
SPECTRAL = [name + "spectral" for name in _NAMES if name + "spectral" in mi.variants()]


def later(*values: object) -> list[object]:
    """Mark parameters as slow."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


#: What mono does of its own, tests of colour say; `make test-all` runs all of it.
VARIANTS = [*RGB, *SPECTRAL, *later(*MONO)]
