"""Fields that are in memory already, as parts of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi

from mi_nerfattack.plugins.brick_field import BrickFieldVolume
from mi_nerfattack.plugins.field_integrator import FieldIntegrator
from mi_nerfattack.plugins.field_volume import AbstractFieldVolume
from mi_nerfattack.plugins.grid_field import GridFieldVolume
from mi_nerfattack.plugins.ngp_field import NGPFieldVolume
from mi_nerfattack.plugins.splat_background import SplatBackgroundVolume
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.splatting.background import SplatBackground

_KINDS: dict[str, type[AbstractFieldVolume]] = {
    kind.kind: kind for kind in (GridFieldVolume, NGPFieldVolume, BrickFieldVolume)
}


def volume_of(layer: Layer, name: str, relit: bool = False) -> mi.Volume:
    """Make the volume of a scene that shows a field, or splats, and shares them.

    Args:
        layer: a field, or splats, where they are.
        name: id of the volume, the first part of its parameters' keys.
        relit: whether the scene's emitters light it.
    """
    if isinstance(layer, PosedField):
        plugin = _KINDS[layer.field.kind]
        props = _named(plugin.kind, name)
        props["relit"] = relit
        return plugin(props, layer)
    assert isinstance(layer, SplatBackground)
    return SplatBackgroundVolume(_named("splat_background", name), layer)


def integrator_of(
    volumes: Sequence[mi.Volume], behind: Any, name: str, **options: Any
) -> FieldIntegrator:
    """Make the integrator of volumes, which may be none.

    Args:
        volumes: in their order.
        behind: the nested integrator, or None.
        name: its id.
        options: properties of `field_integrator`.
    """
    props = _named("field_integrator", name)
    nested = [*volumes, behind] if behind is not None else volumes
    for key, value in options.items():
        props[key] = value
    for k, item in enumerate(nested):
        props[f"nested{k}"] = item
    return FieldIntegrator(props, fewest=0)


def _named(plugin: str, name: str) -> mi.Properties:
    props = mi.Properties(plugin)
    props.set_id(name)
    return props
