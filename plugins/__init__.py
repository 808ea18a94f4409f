"""Mitsuba plugins: fields as volumes, emitters and an integrator.

Importing or reloading this module registers the plugins for the active variant. Mitsuba
3.10 does both for the module that an entry point names.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any, NoReturn

import mitsuba as mi

from mi_nerfattack.backend import llvm, variant
from mi_nerfattack.errors import SetupError

__all__ = ["register"]

_MODULES = (
    "field_volume",
    "grid_field",
    "ngp_field",
    "brick_field",
    "splat_background",
    "field_emitter",
    "film",
    "limits",
    "nested",
    "collector",
    "field_integrator",
    "loaded",
    "opencv_camera",
)
_REGISTERED = {
    "register_texture": ("grid_field", "ngp_field", "brick_field", "splat_background"),
    "register_emitter": ("field_emitter",),
    "register_integrator": ("field_integrator",),
    "register_sensor": ("opencv_camera",),
}


def register() -> None:
    """Register all plugins for the active variant, if any, or stubs that say why not.

    Each variant has base classes of its own, so the modules are executed again when
    the variant has changed.

    Raises:
        SetupError: LLVM is missing or too old.
    """
    name = mi.variant()
    if name is None:
        return
    if reason := variant.obstacle(name):
        _refuse(name, reason)
        return
    if name.startswith("llvm"):
        llvm.check_version()
    # A package that imports `mitsuba.ad` replaces mi.ad with a copy that no change of
    # variant reloads, and scenes ignore integrators whose base class is out of date.
    setattr(mi, "ad", importlib.import_module("mitsuba.python.ad"))  # noqa: B010
    for module in _MODULES:
        full = f"{__name__}.{module}"
        if full in sys.modules:
            importlib.reload(sys.modules[full])
        else:
            importlib.import_module(full)


def _refuse(active: str, reason: str) -> None:
    """Register stubs for an active variant that the plugins cannot run in.

    Without them Mitsuba would say that it knows no plugin of that name, as it does
    for the volumes in scalar_rgb: it takes the kind of a plugin of any variant from
    what is registered there, Python can register no volume, and whatever else has
    the name makes dictionaries with that name fail in all other variants.
    """
    for function, names in _REGISTERED.items():
        if active == "scalar_rgb" and function == "register_texture":
            continue
        for name in names:
            getattr(mi, function)(name, _stub(name, active, reason))


def _stub(name: str, active: str, reason: str) -> Any:
    def construct(props: Any) -> NoReturn:
        del props
        raise SetupError(
            f"{name}: variant {active} {reason}; call mitsuba.set_variant with one of "
            f"{', '.join(variant.usable())}"
        )

    return construct


register()
