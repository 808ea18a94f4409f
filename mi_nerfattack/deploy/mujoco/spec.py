"""MJCF of a place: its map, its light and a car."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.built_in import BuiltInObject
from mi_nerfattack.deploy.mujoco import car as mjcf_car
from mi_nerfattack.deploy.mujoco.light import (
    SHADOW_RADIUS,
    SUN_DISTANCE,
    add_lighting,
    read_lighting,
)
from mi_nerfattack.deploy.mujoco.map import add_meshes, built_in_mesh, read_meshes
from mi_nerfattack.deploy.mujoco.module import mujoco

NEAR_M = 0.05
_SHADOW_PX = 2048
# The sky stands at 0.7 of it; the sun's shadow map ends there, too.
_FAR, _LEAST_FAR_M = 4.0, 2 * (SUN_DISTANCE + SHADOW_RADIUS)  # radii of the map


def map_spec(
    scene: Any, built_in: Sequence[BuiltInObject] = (), exposure_ev: float = 0.0
) -> mujoco.MjSpec:
    """Describe a Mitsuba scene for MuJoCo: meshes, textures, light, level ground.

    Args:
        scene: `mi.Scene`, metric, z up; meshes and rectangles of opaque materials.
        built_in: more objects.
        exposure_ev: its light, of lamps as well, is multiplied by two to this power.

    Returns:
        what compiles to a model without joints; the ground that cars drive on is the
        plane z = 0, whatever is drawn.

    Raises:
        InputError: something in the scene cannot be drawn.
    """
    meshes = read_meshes(scene)
    meshes += [built_in_mesh(index, item) for index, item in enumerate(built_in)]
    gain = 2.0**exposure_ev
    lighting = read_lighting(scene).scaled(gain)
    spec = mujoco.MjSpec()
    mjcf_car.add_ground(spec)
    add_meshes(spec, meshes, lighting.white, gain=gain)
    add_lighting(spec, lighting)
    _set_visual(spec, np.concatenate([mesh.vertices for mesh in meshes]))
    return spec


def _set_visual(spec: mujoco.MjSpec, vertices: np.ndarray) -> None:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    radius = max(0.5 * float(np.linalg.norm(high - low)), 1.0)
    spec.stat.center, spec.stat.extent = (low + high) / 2, radius
    view = spec.visual
    view.map.znear = NEAR_M / radius
    view.map.zfar = max(_FAR, _LEAST_FAR_M / radius)
    view.map.shadowclip = SHADOW_RADIUS / radius
    view.quality.shadowsize, view.quality.offsamples = _SHADOW_PX, 0
