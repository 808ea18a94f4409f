"""Let Dr.Jit load this environment's LLVM, whoever imports it first.

Installed next to the package as ``mi_nerfattack_llvm``, which a .pth file imports when
Python starts; see packaging.py.
It looks for nothing until ``drjit`` is imported.
"""

import os
import sys  # and nothing that takes longer


class BeforeDrJit:
    """Finder of modules that finds none; it sets LLVM's path when Dr.Jit is wanted."""

    @classmethod
    def find_spec(cls, name: str, path: object = None, target: object = None) -> None:
        """Prepare the import of `drjit`, once."""
        del path, target
        if name != "drjit":
            return
        sys.meta_path.remove(cls)
        if "DRJIT_LIBLLVM_PATH" in os.environ:
            return
        try:
            _setup()
        except Exception:  # importing mi_nerfattack tells it; others' code goes on
            return


def _setup() -> None:
    """Run `mi_nerfattack.backend.llvm.setup`, without the package: it needs Dr.Jit."""
    from importlib import util

    package = util.find_spec("mi_nerfattack")
    if package is None or package.origin is None:
        return
    file = os.path.join(os.path.dirname(package.origin), "backend", "llvm.py")
    spec = util.spec_from_file_location("mi_nerfattack_llvm_path", file)
    if spec is None or spec.loader is None:
        return
    module = util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    module.setup()


if "drjit" not in sys.modules:
    sys.meta_path.insert(0, BeforeDrJit)
