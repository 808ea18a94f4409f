"""The two worlds that policies are trained and validated in, from their files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from mi_nerfattack import files
from mi_nerfattack.deploy.mitsuba import PathTracedSensor
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.io import load_field, load_grid
from mi_nerfattack.policy.collect import World
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE
from mi_nerfattack.policy.placement import scene_ground
from mi_nerfattack.render.camera import Camera, CameraMount, from_fov
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.scene import load_scene
from mi_nerfattack.rollout.field_sensor import FieldSensor
from mi_nerfattack.vehicle.route import Route


@dataclass(frozen=True)
class WorldFiles:
    """Files of a scene in both forms.

    Args:
        scene: Mitsuba XML: the deployment world, and the ground of both.
        field: the scene's field: the surrogate world.
        objects: grid fields for the roadside; may be empty.
        routes: JSON.
    """

    scene: Path
    field: Path
    objects: tuple[Path, ...]
    routes: Path

    def load_routes(self) -> list[Route]:
        """Read all routes of the file."""
        table = files.read_json(self.routes)
        if not isinstance(table, dict) or not table:
            raise InputError(f"{self.routes}: needs an object with one key per route")
        return [Route.from_file(self.routes, name) for name in table]


def policy_camera() -> Camera:
    """Return the camera of the policies: 200x66 pixels, 90 degrees."""
    height, width = IMAGE_SHAPE
    return from_fov(width, height, 90.0)


def load_surrogate(
    paths: WorldFiles, mount: CameraMount | None = None
) -> tuple[World, str]:
    """Load the world rendered from fields.

    Returns:
        The world, and what identifies it.
    """
    ground = scene_ground(load_scene(paths.scene))
    objects = tuple(load_grid(path) for path in paths.objects)
    camera, mount = policy_camera(), mount or CameraMount()
    sensor = FieldSensor(PosedField(load_field(paths.field)), [], camera, mount)
    origin = _origin([paths.scene, paths.field, *paths.objects], camera, mount)
    return World("surrogate", sensor, objects, ground), origin


def load_deployment(
    paths: WorldFiles, spp: int, seed: int, mount: CameraMount | None = None
) -> tuple[World, str]:
    """Load the path-traced world.

    Args:
        paths: see there; the field is not read.
        spp: samples per pixel.
        seed: of the samples.
        mount: of the camera; None for the default.

    Returns:
        The world, and what identifies it.
    """
    scene = load_scene(paths.scene)
    objects = tuple(load_grid(path) for path in paths.objects)
    camera, mount = policy_camera(), mount or CameraMount()
    sensor = PathTracedSensor(scene, [], camera, mount, spp, seed)
    origin = _origin([paths.scene, *paths.objects], camera, mount, spp=spp, seed=seed)
    return World("deployment", sensor, objects, scene_ground(scene)), origin


def _origin(
    paths: Sequence[Path], camera: Camera, mount: CameraMount, **other: int
) -> str:
    """Describe what decides about the images: checksums and numbers, as JSON."""
    # the folder tells files of equal names apart
    sums = {
        f"{path.resolve().parent.name}/{path.name}": hashlib.sha256(
            path.read_bytes()
        ).hexdigest()
        for path in paths
    }
    about = {"files": sums, "camera": asdict(camera), "mount": asdict(mount), **other}
    return json.dumps(about, sort_keys=True)
