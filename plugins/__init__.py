"""Mitsuba plugins: fields as volumes, emitters and an integrator."""

from __future__ import annotations

import importlib
import sys
from typing import Any, NoReturn

from mi_nerfattack.errors import SetupError

__all__ = ["refuse", "register"]

_MODULES = (
    "field_volume",
    "grid_field",
    "ngp_field",
    "splat_background",
    "field_emitter",
    "aovs",
    "film",
    "limits",
    "nested",
    "field_integrator",
    "opencv_camera",
)
_REGISTERED = {
    "register_texture": ("grid_field", "ngp_field", "splat_background"),
    "register_emitter": ("field_emitter",),
    "register_integrator": ("field_integrator",),
    "register_sensor": ("opencv_camera",),
}


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


def refuse(variant: str, usable: list[str]) -> None:
    """Register stubs for an active variant that the plugins cannot run in.

    Without them Mitsuba would say that it knows no plugin of that name, as it does
    for the volumes in scalar_rgb: it takes the kind of a plugin of any variant from
    what is registered there, Python can register no volume, and whatever else has
    the name makes dictionaries with that name fail in all other variants.

    Args:
        variant: the active variant.
        usable: the variants that the message names.
    """
    import mitsuba as mi

    for function, names in _REGISTERED.items():
        if variant == "scalar_rgb" and function == "register_texture":
            continue
        for name in names:
            getattr(mi, function)(name, _stub(name, variant, usable))


def _stub(name: str, variant: str, usable: list[str]) -> Any:
    def construct(props: Any) -> NoReturn:
        del props
        raise SetupError(
            f"{name}: variant {variant} has no derivatives or is polarised; call "
            f"mitsuba.set_variant with one of {', '.join(usable)}"
        )

    return construct
