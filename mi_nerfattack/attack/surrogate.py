"""A loaded Mitsuba scene as the sensor that attacks are made through."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, NGPField
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera.conventions import from_mitsuba
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.surroundings import Clip, Surroundings
from mi_nerfattack.rollout.field_sensor import FieldSensor


def surrogate_sensor(
    scene: mi.Scene,
    mount: CameraMount | None = None,
    attacked: Sequence[str] | None = None,
    seed: int = 0,
) -> FieldSensor:
    """Make the sensor that sees a scene as its `field_integrator` renders it.

    Its images are those of `mi.render`, one sample through the centre of each pixel,
    from wherever the vehicle is, as sRGB: same volumes, composite, `stop` and jitter,
    lens and clip distances of the scene's first sensor (whose pose counts for nothing).
    Shapes end rays; what the nested integrator shows behind, with the sample count of
    the sensor's sampler, is a constant of each frame. So are all other volumes.

    Sensor and scene share the fields: a texture that one is given, the other shows.

    Args:
        scene: metric, z up; one `perspective` or `opencv_camera`.
        mount: pose of the camera on the vehicle.
        attacked: ids of the `grid_field`s with textures to change, in the order of the
            sensor's textures; None for all but one called ``scene``.
        seed: of jitter and of the nested integrator's samples, renewed each step and
            replayed by derivatives.

    Raises:
        InputError: another integrator or sensor, a film with a crop window, a volume
            that is `relit`, no grid field of a name.
        SetupError: a nested integrator, and a variant without colour.
    """
    integrator = _field_integrator(scene)
    volumes = {volume.id(): volume for volume in integrator.volumes}
    grids = [name for name, volume in volumes.items() if _is_grid(volume)]
    if attacked is None:
        attacked = [name for name in grids if name != "scene"]
    if unknown := [name for name in attacked if name not in grids]:
        allowed = ", ".join(grids)
        raise InputError(
            f"attacked: no grid_field {unknown[0]!r}; there are: {allowed}"
        )
    for name, volume in volumes.items():
        if volume.relit:
            raise InputError(
                f"{name}: relit fields are not part of attacks; set relit to false"
            )
    others = [v.posed for k, v in volumes.items() if k not in attacked]
    camera, clip, sampler = _lens(scene)
    surrounded = scene.shapes() or integrator.behind is not None
    parts = scene, integrator.behind, sampler, camera, clip, seed
    return FieldSensor(
        sorted(others, key=_has_no_sky),
        [volumes[name].posed for name in attacked],
        camera,
        mount,
        seed if integrator.jitter else None,
        integrator.stop,
        integrator.composite,
        Surroundings(*parts) if surrounded else None,
        clip,
    )


def _field_integrator(scene: mi.Scene) -> Any:
    from mi_nerfattack.plugins.field_integrator import FieldIntegrator  # of the variant

    integrator: Any = scene.integrator()
    if not isinstance(integrator, FieldIntegrator):
        raise InputError(
            f"scene: its integrator is a {integrator.class_name()}; a surrogate needs "
            "a field_integrator, with the other one nested in it"
        )
    return integrator


def _is_grid(volume: Any) -> bool:
    layer = volume.posed
    return isinstance(layer, PosedField) and isinstance(layer.field, GridField)


def _has_no_sky(layer: Layer) -> bool:
    """Sort first the field whose background `field_integrator` shows."""
    return not (isinstance(layer, PosedField) and isinstance(layer.field, NGPField))


def _lens(scene: mi.Scene) -> tuple[Camera, Clip, mi.Sampler]:
    """Read the intrinsics, clip distances and sampler of the first sensor."""
    if not scene.sensors():
        raise InputError("scene: no sensor; add a perspective or an opencv_camera")
    sensor: Any = scene.sensors()[0]
    parameters = mi.traverse(sensor)
    if "aperture_radius" in parameters:
        raise InputError(f"sensor {sensor.id()!r}: has an aperture; use perspective")
    camera, _ = from_mitsuba(sensor)
    size = camera.width, camera.height
    if tuple(map(int, sensor.film().crop_size())) != size:
        raise InputError(
            f"sensor {sensor.id()!r}: its film has a crop window; remove crop_* from it"
        )
    near, far = (
        float(np.array(parameters[name]).ravel()[0])
        for name in ("near_clip", "far_clip")
    )
    return camera, Clip(near, far), sensor.sampler()
