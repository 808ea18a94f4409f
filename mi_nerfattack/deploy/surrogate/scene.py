"""Scenes made of fields that are in memory, as what policies see."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera.conventions import mitsuba_sensor_dict
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.interleaved import COMPOSITES
from mi_nerfattack.render.march import STOP
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.scene_sensor import SceneSensor

_FIELDS = "fields"  # id of the integrator, the first part of all keys
_NEAR_M = 1e-6  # the lattice of samples begins where rays do


def field_sensor(
    scene: Layer | Sequence[Layer],
    objects: Sequence[PosedField],
    camera: Camera,
    mount: CameraMount | None = None,
    jitter_seed: int | None = None,
    stop: float = STOP,
    composite: str = "depth",
    names: Sequence[str] = (),
    spp: int = 1,
) -> SceneSensor:
    """Write the scene of fields and a camera, and see it through a `field_integrator`.

    Rays go through the middles of equal squares of a pixel. The sensor's parameters
    are the colours of the objects. Scene and sensor share the fields with whoever gave
    them.

    Args:
        scene: fields, splats or bricks; behind all is the sky of the first that has
            one.
        objects: grid fields whose colours an attack may change; may be empty.
        camera: intrinsics.
        mount: pose on the vehicle.
        jitter_seed: seed of sample positions along rays, renewed each period; None
            places samples at the middle of their intervals.
        stop: transmittance at which rays end.
        composite: ``depth`` or ``interleaved``.
        names: ids of the objects' volumes; ``object``, ``object1``, ... by default.
        spp: rays per pixel, a square number; their mean is taken in linear RGB.

    Raises:
        InputError: no such composite, layers that it cannot take, or `spp` is no
            square number.
        TypeError: an object that is no grid field.
        ValueError: two objects that share a field.
    """
    if composite not in COMPOSITES:
        allowed = ", ".join(COMPOSITES)
        raise InputError(f"composite: {composite!r}; allowed: {allowed}")
    if names and len(names) != len(objects):
        raise ValueError(f"names: {len(names)} given for {len(objects)} objects")
    _check(objects)
    layers = scene if isinstance(scene, Sequence) else (scene,)
    free = _names("scene", set(names))
    others = [_volume(layer, next(free)) for layer in layers]
    called = iter(names) if names else _names("object", set())
    shown = [_volume(item, next(called)) for item in objects]
    options = {"composite": composite, "stop": stop, "jitter": jitter_seed is not None}
    lens = mitsuba_sensor_dict(camera, np.eye(4), spp) | {"near_clip": _NEAR_M}
    return _see(
        Shown(others, shown, options=options),
        [mi.load_dict(lens)],
        mount=mount,
        seed=jitter_seed or 0,
        centred=True,
    )


def showing(
    sensor: SceneSensor,
    objects: Sequence[PosedField],
    scene: Layer | None = None,
    mounts: Sequence[CameraMount] = (),
) -> SceneSensor:
    """Return a sensor like another one that shows other objects, or another scene.

    Args:
        sensor: sees a scene by a `field_integrator`; what it differentiates by counts
            as its objects.
        objects: grid fields.
        scene: in the place of its other fields.
        mounts: poses of the cameras on the vehicle, if others.

    Raises:
        InputError: another integrator, or shapes that no other scene can share.
    """
    _check(objects)
    integrator, camera = _field_integrator(sensor), sensor.camera
    own = [id(posed) for posed in sensor.objects]
    known = {id(volume.posed): volume for volume in integrator.volumes}
    others = [volume for k, volume in known.items() if k not in own]
    taken = {volume.id() for volume in known.values()}
    if scene is not None:
        others = [_volume(scene, next(_names("scene", taken)))]
    free = _names("object", taken)
    relit = {id(v.field) for v in known.values() if v.relit}
    shown = [
        known.get(id(item)) or _volume(item, next(free), id(item.field) in relit)
        for item in objects
    ]
    children = [*sensor.scene.shapes(), *_free_lights(sensor.scene)]
    options = {"stop": integrator.stop, "jitter": integrator.jitter}
    rule = next(k for k, v in COMPOSITES.items() if type(integrator.composite) is v)
    if integrator.relighting is not None:
        options["relit_samples"] = integrator.relighting.samples
    result = _see(
        Shown(others, shown, integrator.behind, {"composite": rule, **options}),
        [camera.sensor, *children],
        centred=camera.centred,
    )
    return result.seeing_as(sensor, mounts)


def scene_sensor(
    scene: mi.Scene, mount: CameraMount | None, names: Sequence[str], seed: int = 0
) -> SceneSensor:
    """See a loaded scene, with the colours of some of its objects as parameters.

    Args:
        scene: metric, z up, with a `field_integrator`.
        mount: pose of the camera on the vehicle.
        names: ids of the objects' `grid_field` volumes, in the order of the textures.
        seed: of all random numbers.

    Raises:
        InputError: no `grid_field` of a name; see `SceneSensor`, too.
    """
    sensor = SceneSensor(scene, mount, seed=seed)
    volumes = _field_integrator(sensor).volumes
    by_name = {
        volume.id(): key
        for key, (_, _, node, _) in sensor.params.properties.items()
        if key.endswith(".colour")
        for volume in volumes
        if volume is node
    }
    for name in names:
        if name not in by_name:
            there = ", ".join(by_name) or "none"
            raise InputError(f"scene: no grid_field {name!r}; there are: {there}")
    sensor.select([by_name[name] for name in names])
    return sensor


@dataclass(frozen=True)
class Shown:
    """What a `field_integrator` shows.

    Attributes:
        others: volumes without colours to attack.
        objects: volumes with them.
        behind: the nested integrator, if any.
        options: properties of the integrator.
    """

    others: Sequence[Any]
    objects: Sequence[Any]
    behind: Any = None
    options: Mapping[str, Any] = field(default_factory=dict)


def _see(shown: Shown, children: Sequence[Any], **view: Any) -> SceneSensor:
    """Make a scene.

    Args:
        shown: by its integrator.
        children: its sensor first, shapes and lights.
        view: arguments of `SceneSensor`.
    """
    from mi_nerfattack.plugins.loaded import integrator_of  # of the variant

    volumes = [*shown.others, *shown.objects]
    integrator = integrator_of(volumes, shown.behind, _FIELDS, **shown.options)
    props = mi.Properties("scene")
    for k, child in enumerate((integrator, *children)):
        props[f"part{k}"] = child
    try:
        scene: Any = mi.PluginManager.instance().create_object(props)
    except IndexError as err:  # Mitsuba does not give the shapes that it is made of
        raise InputError(
            "scene: has an instance of a shapegroup, which no other scene can share; "
            "put meshes in its place"
        ) from err
    params = [f"{_FIELDS}.{volume.id()}.colour" for volume in shown.objects]
    return SceneSensor(scene, params=params, **view)


def _volume(layer: Layer, name: str, relit: bool = False) -> Any:
    from mi_nerfattack.plugins.loaded import volume_of  # of the variant

    return volume_of(layer, name, relit)


def _names(head: str, taken: set[str]) -> Iterator[str]:
    """Yield names that are free: the head, then with numbers."""
    for k in count():
        if (name := f"{head}{k or ''}") not in taken:
            yield name


def _field_integrator(sensor: SceneSensor) -> Any:
    from mi_nerfattack.plugins.field_integrator import FieldIntegrator  # of the variant

    if not isinstance(sensor.integrator, FieldIntegrator):
        raise InputError(
            f"scene: its integrator is a {type(sensor.integrator).__name__}; objects "
            "are shown by a field_integrator, with the other one nested in it"
        )
    return sensor.integrator


def _check(objects: Sequence[PosedField]) -> None:
    for posed in objects:
        if not isinstance(posed.field, GridField):
            raise TypeError(f"objects: {posed.field.kind}; grid fields are needed")
    if len({id(posed.field) for posed in objects}) < len(objects):
        raise ValueError(
            "objects: two of them share a field, and so a texture; load it twice"
        )


def _free_lights(scene: mi.Scene) -> list[Any]:
    """Return the emitters that are no part of a shape."""
    surface = mi.EmitterFlags.Surface
    return [x for x in scene.emitters() if not mi.has_flag(x.flags(), surface)]
