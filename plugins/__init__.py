"""Mitsuba plugins: fields as volumes, emitters and an integrator."""

from __future__ import annotations

import importlib
import sys

_MODULES = (
    "field_volume",
    "grid_field",
    "ngp_field",
    "field_emitter",
    "field_integrator",
)


def register() -> None:
    """Register all plugins for the active variant.

    Each variant has base classes of its own, so the modules are executed again when
    the variant has changed.
    """
    for name in _MODULES:
        full = f"{__name__}.{name}"
        if full in sys.modules:
            importlib.reload(sys.modules[full])
        else:
            importlib.import_module(full)
