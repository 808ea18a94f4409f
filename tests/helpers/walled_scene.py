"""A Mitsuba scene in which a wall stands between two fields, small enough for loops."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from helpers import toy_loop as toy
from helpers.small_fields import small_ngp

from mi_nerfattack.fields import GridLayout, save_field
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.conventions import opencv_to_mitsuba
from mi_nerfattack.render.camera.intrinsics import mount_matrix
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import ExplicitEuler

LENS = {
    "type": "opencv_camera",
    "fx": 17.0,
    "fy": 16.5,
    "cx": 11.6,
    "cy": 5.3,
    "k1": -0.12,
    "p1": 0.004,
}
PERSPECTIVE = {"type": "perspective", "fov": 70.0, "near_clip": 0.3}


def write_fields(folder: Path) -> None:
    """Write the fields that `scene_dict` names."""
    save_field(
        folder / "near.safetensors", toy.blob(GridLayout(3, 6, 12), 1, 2, 0.2, 2)
    )
    save_field(folder / "far.safetensors", toy.blob(GridLayout(3, 6, 12), 1, 3, 0.2, 3))
    save_field(folder / "fog.safetensors", toy.blob(GridLayout(2, 6, 9), 25, -2, 1, 1))
    save_field(folder / "sky.safetensors", small_ngp())


def volume(folder: Path, name: str, position: list[float], scale: float) -> Any:
    """Describe a grid field."""
    to_world = mi.ScalarTransform4f().translate(position).scale(scale)
    file = str(folder / f"{name}.safetensors")
    return {"type": "grid_field", "filename": file, "to_world": to_world}


def scene_dict(
    folder: Path, lens: dict[str, Any] = LENS, walls: bool = True, **integrator: Any
) -> dict[str, Any]:
    """Describe the scene; without walls there is no surface and no nested integrator.

    A point light and two bounces leave nothing random, beyond where the samples are.
    """
    wall = (
        mi.ScalarTransform4f()
        .translate([6, 0.2, 0.9])
        .rotate([0, 1, 0], -90)
        .scale([0.9, 0.5, 1])
    )
    built = {
        "wall": {
            "type": "rectangle",
            "to_world": wall,
            "bsdf": {
                "type": "twosided",
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": [0.2, 0.6, 0.9]},
                },
            },
        },
        "lamp": {"type": "point", "position": [0, 1, 4], "intensity": 60.0},
    }
    nested = {"behind": {"type": "path", "max_depth": 2}}
    return {
        "type": "scene",
        "integrator": {
            "type": "field_integrator",
            "composite": "depth",
            "stop": 0.0,
            "far": volume(folder, "far", [8.0, 0.5, 1.0], 1.6),
            "near": volume(folder, "near", [3.5, -0.6, 1.0], 0.7),
            "scene": volume(folder, "fog", [0, 0, 0], 1),
            **(nested if walls else {}),
            **integrator,
        },
        **(built if walls else {}),
        "sensor": {
            **lens,
            "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
            "film": {
                "type": "hdrfilm",
                "width": toy.WIDTH,
                "height": toy.HEIGHT,
                "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
        },
    }


def load(description: dict[str, Any]) -> mi.Scene:
    """Load a description."""
    return mi.load_dict(description, parallel=False)


def rendered(description: dict[str, Any], state: np.ndarray) -> np.ndarray:
    """Let Mitsuba render what a vehicle with `toy.MOUNT` sees, linear (h, w, 3)."""
    matrix = opencv_to_mitsuba(mount_matrix(state, toy.MOUNT)[0])
    sensor = {**description["sensor"], "to_world": mi.ScalarTransform4f(matrix)}
    scene = load({**description, "sensor": sensor})
    return mi.render(scene, spp=1).numpy()[..., :3]


def close_loop(sensor: Any) -> ClosedLoop:
    """Drive by the toy's policy."""
    policy = TorchPolicy(toy.SmoothPolicy())
    vehicle = Dubins(toy.SPEED, toy.LIMIT)
    parts = sensor, policy, 0, vehicle, ExplicitEuler(), toy.DT
    return ClosedLoop(*parts, eight_bit=False)  # compared with finite differences
