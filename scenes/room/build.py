"""Write the room: scene.xml, meshes, textures and routes.json.

Run ``python -m mi_nerfattack.scenes.room.build [--seed N] [--out FOLDER]``. The same
seed gives the same bytes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..atlas import paint_atlas
from ..mesh import MeshBuilder, box_faces, level
from ..place import main, scene_xml, write_place
from .furniture import furniture
from .layout import HEIGHT, LENGTH, WIDTH, routes
from .paint import WALL_SCALE, WALLS, floor_image, wall_length, wall_rows, walls_image

_PANEL = (1.6, 1.2)  # of the light in the ceiling, metres
_RADIANCE = 23.0

_LIGHT = """    <shape type="ply" id="light">
        <string name="filename" value="meshes/light.ply"/>
        <bsdf type="diffuse"/>
        <emitter type="area">
            <rgb name="radiance" value="{radiance}"/>
        </emitter>
    </shape>
"""


def walls() -> MeshBuilder:
    """Return the four walls, facing inwards, each with its strip of the image."""
    mesh = MeshBuilder()
    low = np.array([-LENGTH / 2, -WIDTH / 2, 0.0])
    faces = box_faces(low, -low + [0, 0, HEIGHT])
    rows = len(WALLS) * wall_rows()
    for k, name in enumerate(WALLS):
        # as seen from inside: turned around, beginning at the bottom left
        corners = faces[name][[1, 0, 3, 2]]
        right = (wall_length(name) * WALL_SCALE - 0.5) / round(LENGTH * WALL_SCALE)
        left = 0.5 / round(LENGTH * WALL_SCALE)
        top, foot = (k * wall_rows() + 0.5) / rows, ((k + 1) * wall_rows() - 0.5) / rows
        uvs = [(left, foot), (right, foot), (right, top), (left, top)]
        mesh.quad(corners, np.array(uvs))
    return mesh


def ceiling(length: float, width: float, height: float) -> MeshBuilder:
    """Return a rectangle around the origin that faces down, metres."""
    mesh = MeshBuilder()
    x, y = length / 2, width / 2
    corners = [(-x, y, height), (x, y, height), (x, -y, height), (-x, -y, height)]
    mesh.quad(np.array(corners), np.array([(0, 1), (1, 1), (1, 0), (0, 0)]))
    return mesh


def build(folder: Path, seed: int) -> list[Path]:
    """Write the scene below folder and return the files written."""
    meshes = {
        "floor": level(-LENGTH / 2, LENGTH / 2, -WIDTH / 2, WIDTH / 2),
        "walls": walls(),
        "ceiling": ceiling(LENGTH, WIDTH, HEIGHT),
        "furniture": furniture(seed),
    }
    images = {
        "floor": floor_image(seed),
        "walls": walls_image(seed),
        "ceiling": np.full((4, 4, 3), 0.9),
        "furniture": paint_atlas([], seed),
    }
    radiance = ", ".join(f"{_RADIANCE * tint:g}" for tint in (1.0, 0.98, 0.94))
    scene = scene_xml(
        "Room with a square track: metres, z up; images need no exposure.",
        fov="95",
        lookat='origin="0, -0.6, 2.6" target="0, 0, 0" up="0, 1, 0"',
        lights=_LIGHT.format(radiance=radiance),
        wraps=dict.fromkeys(meshes, "clamp"),
        rr_depth=4,
    )
    meshes["light"] = ceiling(*_PANEL, HEIGHT - 0.02)
    return write_place(
        folder, meshes=meshes, images=images, scene=scene, routes=routes()
    )


if __name__ == "__main__":
    main(__doc__, build, seed=5, folder=Path(__file__).parent)
