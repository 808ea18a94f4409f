"""Find, measure and repair failures of image-based driving policies.

Importing this package points Dr.Jit to a usable LLVM and registers the Mitsuba
plugins for the active variant and for every later one.
"""

from __future__ import annotations

from mi_nerfattack.backend import llvm as _llvm
from mi_nerfattack.errors import InputError, NerfAttackError, SetupError

_llvm.setup()

from mi_nerfattack.backend import variant  # noqa: E402  imports drjit, after LLVM

__version__ = "0.1.0"

__all__ = ["InputError", "NerfAttackError", "SetupError", "__version__", "variant"]

variant.install()
