"""Find, measure and repair failures of image-based driving policies.

Importing this package points Dr.Jit to a usable LLVM and registers the Mitsuba
plugins for the active variant and for every later one.
"""

from __future__ import annotations

from mi_nerfattack.backend import llvm as _llvm

_llvm.setup()  # before anything imports drjit

from mi_nerfattack.backend import variant  # noqa: E402
from mi_nerfattack.errors import InputError, NerfAttackError, SetupError  # noqa: E402

__version__ = "0.1.0"

__all__ = ["InputError", "NerfAttackError", "SetupError", "__version__", "variant"]

variant.install()
