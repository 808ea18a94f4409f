"""What `field_integrator` can be differentiated by, and what it refuses."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.arrays import differentiates_rays
from mi_nerfattack.errors import InputError
from mi_nerfattack.plugins.field_emitter import FieldEmitter
from mi_nerfattack.render.backdrop import fields_by_rays

ATTACHED = "attached"
_RELIT = (
    "{}: has no derivative where fields are relit, since their light is a constant; "
    "set relit to false, or keep this parameter detached"
)


def check(
    integrator: Any, scene: mi.Scene, keys: Collection[str] | None = None
) -> bool:
    """Look for parameters to differentiate by, and refuse what is not computed.

    Args:
        integrator: a `field_integrator`.
        scene: that it renders.
        keys: of the parameters; by default those that have gradients enabled.

    Returns:
        whether the nested integrator has to be differentiated.

    Raises:
        InputError: a derivative is not computed; the message names what works.
    """
    params = mi.traverse(scene)
    attached = [
        (key, node, flags)
        for key, (value, kind, node, flags) in params.properties.items()
        if (key in keys if keys is not None else _is_attached(value, kind, node))
    ]
    sensors = [(key, node) for key, node, _ in attached if isinstance(node, mi.Sensor)]
    others = [
        key
        for key, node, flags in attached
        if not isinstance(node, mi.Sensor)
        and not _is_own(integrator, node)
        and _has_effect(integrator, key, flags)
    ]
    if integrator.relighting is not None:
        for key, node, _ in attached:
            _check_relit(integrator, key, node)
    if sensors:
        check_camera(integrator, scene, sensors[0][0])
    shared = _shared(integrator, scene, [node for _, node, _ in attached])
    for key in [*others, *shared]:
        _check_behind(integrator, key)
    return bool(others or shared)


def check_camera(integrator: Any, scene: mi.Scene, key: str) -> None:
    """Raise InputError where rays have no derivative by the camera.

    Args:
        integrator: a `field_integrator`.
        scene: that it renders.
        key: of the sensor's parameter; ``attached`` for the drives of a loop.
    """
    other = "differentiate by to_world of the fields"
    if key == ATTACHED:
        other = "set attached to false"
    if scene.shapes() or integrator.behind is not None:
        raise InputError(
            f"{key}: surfaces and a nested integrator have no derivative by the "
            f"camera; take them out of the scene, or {other}"
        )
    if integrator.relighting is not None:
        raise InputError(_RELIT.format(key))
    for item in fields_by_rays(integrator.posed):
        item.check_continuous(key)


def _check_relit(integrator: Any, key: str, node: Any) -> None:
    """Refuse what shadows and normals depend on, which are constants."""
    if _is_own(integrator, node) and not key.endswith(".colour"):
        raise InputError(_RELIT.format(key))


def attached(scene: mi.Scene) -> list[Any]:
    """Return the parameters of a scene that have gradients enabled."""
    values = [_value(*item[:3]) for item in mi.traverse(scene).properties.values()]
    return [value for value in values if dr.grad_enabled(value)]


def _value(value: Any, kind: Any, node: Any) -> Any:
    return mi.get_property(value, kind, node) if kind else value


def _is_attached(value: Any, kind: Any, node: Any) -> bool:
    return dr.grad_enabled(_value(value, kind, node))


def is_attached(ray: mi.Ray3f) -> bool:
    """Tell whether derivatives by the camera are asked for."""
    with dr.resume_grad():
        return dr.grad_enabled(ray.o) or dr.grad_enabled(ray.d)


def check_ray(ray: mi.Ray3f, where: str) -> None:
    """Raise InputError, which says `where`, if a ray has derivatives."""
    if is_attached(ray):
        raise InputError(f"sensor: has no derivative {where}")


def _is_own(integrator: Any, node: Any) -> bool:
    return any(node is volume for volume in integrator.volumes)


def _has_effect(integrator: Any, key: str, flags: Any) -> bool:
    """Tell whether the image depends on a parameter that is no field's."""
    if flags & mi.ParamFlags.Discontinuous:
        raise InputError(
            f"{key}: moves a surface, at which fields end; that has no derivative. "
            "Differentiate by to_world of the fields, or leave them out and use "
            "prb_projective"
        )
    return integrator.behind is not None or integrator.relighting is not None


def _shared(integrator: Any, scene: mi.Scene, attached: list[Any]) -> list[str]:
    """Name the attached fields that an emitter shows, too."""
    if integrator.behind is None:
        return []
    return [
        volume.id()
        for emitter in scene.emitters()
        if isinstance(emitter, FieldEmitter)
        for volume in emitter.volumes
        if any(volume is node for node in attached)
    ]


def _check_behind(integrator: Any, key: str) -> None:
    if integrator.relighting is not None:
        raise InputError(_RELIT.format(key))
    if not differentiates_rays(integrator.behind):
        raise InputError(
            f"{key}: its effect through the nested {integrator.behind.class_name()} "
            'has no derivative; nest <integrator type="prb"/> in its place'
        )
