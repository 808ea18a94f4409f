"""Choose the Mitsuba variant, and register the plugins whenever it changes."""

from __future__ import annotations

import importlib
import logging
import os
import sys

import mitsuba as mi

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
    """Register the plugins now if a variant is set, and after every change."""
    mi.detail.add_variant_callback(_on_change)
    current = mi.variant()
    if current is not None:
        _on_change(None, current)


def _check_name(name: str) -> None:
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
