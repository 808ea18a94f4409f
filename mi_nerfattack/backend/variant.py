"""Choose the Mitsuba variant, and register the plugins whenever it changes."""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from mi_nerfattack.backend import llvm
from mi_nerfattack.backend.interrupts import held_interrupts
from mi_nerfattack.errors import NerfAttackError, SetupError

VARIABLE = "MI_NERFATTACK_VARIANT"
DEFAULT = "llvm_ad_rgb"
_PLUGINS = "mi_nerfattack.plugins"

_log = logging.getLogger("mi_nerfattack")


def ensure() -> str:
    """Set a variant where none is set and return the name of the active one.

    The name comes from the environment variable MI_NERFATTACK_VARIANT, else it is
    llvm_ad_rgb.

    Raises:
        SetupError: the variant is unknown, the plugins do not run in it, or its
            backend (LLVM, CUDA) is missing or too old.
    """
    import mitsuba as mi

    name = mi.variant()
    if name is None:
        name = os.environ.get(VARIABLE, DEFAULT)
        _check_name(name)
        _check_backend(name)
        with held_interrupts():  # else it is set, and nothing is registered
            mi.set_variant(name)
    else:
        _check_name(name)
        _check_backend(name)
    return name


def usable() -> list[str]:
    """Name the variants of this Mitsuba that the plugins run in."""
    import mitsuba as mi

    return [name for name in mi.variants() if obstacle(name) is None]


def obstacle(name: str) -> str | None:
    """Return why the plugins refuse a variant, what it "is" or "has"; None if not."""
    if "_ad_" not in name:
        return "has no derivatives"
    if name.endswith("_polarized"):
        return "is polarised"
    if name.startswith("metal"):
        return (
            "is untried: nobody has run the plugins on Metal, which rounds the float64 "
            "states of a drive to float32"
        )
    return None


def install() -> None:
    """Register the plugins if a variant is set, and after every change.

    Where nobody has imported Mitsuba, this waits until somebody does.
    """
    if sys.modules.get("mitsuba") is not None:
        _follow_changes()
    elif _waiting not in sys.meta_path:
        sys.meta_path.insert(0, _waiting)


def _follow_changes() -> None:
    import mitsuba as mi

    mi.detail.add_variant_callback(_on_change)
    current = mi.variant()
    if current is not None:
        _on_change(None, current)


class _WaitsForMitsuba(MetaPathFinder):
    """Lets the other finders find Mitsuba, and acts once it has been imported."""

    _is_asking = False

    def find_spec(self, fullname: str, *place: Any) -> ModuleSpec | None:
        """Find Mitsuba, with a loader that ends the wait."""
        del place
        if fullname != "mitsuba" or self._is_asking:
            return None
        self._is_asking = True
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            self._is_asking = False
        loader: Any = spec and spec.loader
        if loader is not None:
            execute = loader.exec_module

            def exec_module(module: ModuleType) -> None:
                with held_interrupts(all_of_them=True):  # half of Mitsuba aborts
                    execute(module)
                del loader.exec_module
                if self in sys.meta_path:
                    # another list, for a thread may be in the midst of this one
                    sys.meta_path = [item for item in sys.meta_path if item is not self]
                    _follow_changes()

            loader.exec_module = exec_module
        return spec


_waiting = _WaitsForMitsuba()


def _check_name(name: str) -> None:
    import mitsuba as mi

    if name not in mi.variants():
        raise SetupError(
            f"{VARIABLE}: unknown variant {name!r}; allowed: {', '.join(usable())}"
        )
    if reason := obstacle(name):
        raise SetupError(
            f"variant {name!r} {reason}; call mitsuba.set_variant('{DEFAULT}') or set "
            f"{VARIABLE}={DEFAULT}"
        )


def _check_backend(name: str) -> None:
    import drjit as dr

    if name.startswith("llvm"):
        llvm.check_version()
    elif not dr.has_backend(dr.JitBackend.CUDA):
        raise SetupError(
            f"variant {name!r}: no CUDA device or driver found; "
            f"set {VARIABLE}={DEFAULT} or install the NVIDIA driver"
        )


def _on_change(old: str | None, new: str) -> None:
    """Import or reload the plugins, which register themselves; log errors, never raise.

    Mitsuba 3.9 calls all callbacks in no order, and an exception in one of them keeps
    the others from running.
    """
    del old
    try:
        if _PLUGINS in sys.modules:
            importlib.reload(sys.modules[_PLUGINS])
        else:
            importlib.import_module(_PLUGINS)
    except NerfAttackError as err:
        _log.error("plugins not registered for %s: %s", new, err)
    except Exception:  # whatever it is, other callbacks are to run
        _log.exception("plugins not registered for %s", new)
