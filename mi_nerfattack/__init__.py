"""Find, measure and repair failures of image-based driving policies.

Importing this package points Dr.Jit to a usable LLVM and registers the Mitsuba
plugins for the active variant and for every later one, but loads neither of them. The
names of ``__init__.pyi`` are loaded when they are first used. ``attack_policy``,
``evaluate_policy`` and ``sweep`` run whole experiments; ``attack`` and ``evaluation``
are the packages, because one name cannot be a function and a package.
"""

from __future__ import annotations

import lazy_loader

from mi_nerfattack.backend import llvm as _llvm
from mi_nerfattack.backend import variant

__getattr__, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.1.0"
__all__ = [*_names, "__version__"]  # pyright: ignore[reportUnsupportedDunderAll]

_llvm.setup()
variant.install()
