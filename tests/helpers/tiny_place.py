"""A place whose files are so small that its environments render in milliseconds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from helpers.small_fields import ONES, blob

from mi_nerfattack.deploy.place import Place
from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.fields.io import save_field
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov

SCENE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="3"/></integrator>
  <emitter type="constant"/>
  <shape type="rectangle" id="ground">
    <transform name="to_world"><scale value="60"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.3"/></bsdf>
  </shape>
  <shape type="cube" id="block">
    <transform name="to_world"><translate x="12" y="3" z="1"/></transform>
  </shape>
</scene>"""
POINTS = np.stack([np.linspace(0, 40, 41), np.zeros(41)], axis=1)


def write_place(folder: Path, width: int = 12, height: int = 6) -> Place:
    """Write a scene, a field, an object and two routes, and return their place."""
    (folder / "scene.xml").write_text(SCENE)
    lines = {"straight": POINTS, "bend": POINTS + [0, 1] * np.sin(POINTS / 40)}
    table = {
        name: {
            "goal": goal,
            "points_m": points.tolist(),
            "lane_width_m": 3.5,
            "speed_ms": 5.0,
        }
        for goal, (name, points) in enumerate(lines.items())
    }
    (folder / "routes.json").write_text(json.dumps(table))
    save_field(folder / "field.safetensors", ground_field())
    save_field(folder / "object.safetensors", blob(np.random.default_rng(1)))
    return Place(
        scene=folder / "scene.xml",
        field=folder / "field.safetensors",
        routes=folder / "routes.json",
        objects=(folder / "object.safetensors",),
        camera=from_fov(width, height, 90.0),
        mount=CameraMount(),
    )


def ground_field() -> GridField:
    """Make a slab of the ground, 4 m deep, coloured at random."""
    layout, reach = GridLayout(2, 8, 16), 60 * ONES
    lower, upper = -reach, reach.copy()
    lower[2], upper[2] = -4.0, 0.0
    field = GridField(layout, lower, upper, step_m=0.5)
    rng = np.random.default_rng(0)
    density = np.full(field.n_vertices, 1.0, np.float32)
    texture = rng.normal(0, 1, (field.n_vertices, 3)).astype(np.float32)
    field.set_parameter("density", density)
    field.set_parameter("texture", texture)
    return field
