"""Write the room: scene.xml, meshes, textures and routes.json.

Run ``python -m mi_nerfattack.scenes.room.build [--seed N] [--out FOLDER]``. The same
seed gives the same bytes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from ..intersection.build import SHAPE, write_parts, write_texts
from ..intersection.facades import paint_atlas
from ..intersection.ground import road
from ..intersection.mesh import MeshBuilder, box_faces
from .furniture import furniture
from .layout import HEIGHT, LENGTH, WIDTH, routes
from .paint import WALL_SCALE, WALLS, floor_image, wall_length, wall_rows, walls_image

_PANEL = (1.6, 1.2)  # of the light in the ceiling, metres
_RADIANCE = 23.0

_SCENE = """<!-- Room with a square track: metres, z up; images need no exposure. -->
<scene version="3.0.0">
    <default name="spp" value="16"/>
    <default name="width" value="600"/>
    <default name="height" value="400"/>

    <integrator type="path">
        <integer name="max_depth" value="4"/>
        <integer name="rr_depth" value="4"/>
    </integrator>

    <sensor type="perspective" id="overview">
        <float name="fov" value="95"/>
        <transform name="to_world">
            <lookat origin="0, -0.6, 2.6" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <rfilter type="box"/>
        </film>
    </sensor>

    <shape type="ply" id="light">
        <string name="filename" value="meshes/light.ply"/>
        <bsdf type="diffuse"/>
        <emitter type="area">
            <rgb name="radiance" value="{light}"/>
        </emitter>
    </shape>
{shapes}</scene>
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


def level(length: float, width: float, height: float) -> MeshBuilder:
    """Return a rectangle around the origin that faces down, metres."""
    mesh = MeshBuilder()
    x, y = length / 2, width / 2
    corners = [(-x, y, height), (x, y, height), (x, -y, height), (-x, -y, height)]
    mesh.quad(np.array(corners), np.array([(0, 1), (1, 1), (1, 0), (0, 0)]))
    return mesh


def build(folder: Path, seed: int) -> list[Path]:
    """Write the scene below folder and return the files written."""
    meshes = {
        "floor": road(-LENGTH / 2, LENGTH / 2, -WIDTH / 2, WIDTH / 2),
        "walls": walls(),
        "ceiling": level(LENGTH, WIDTH, HEIGHT),
        "furniture": furniture(seed),
    }
    images = {
        "floor": floor_image(seed),
        "walls": walls_image(seed),
        "ceiling": np.full((4, 4, 3), 0.9),
        "furniture": paint_atlas([], seed),
    }
    files = write_parts(folder, meshes, images)
    files.append(folder / "meshes" / "light.ply")
    level(*_PANEL, HEIGHT - 0.02).write_ply(files[-1])
    shapes = "".join(SHAPE.format(name=name, wrap="clamp") for name in meshes)
    light = ", ".join(f"{_RADIANCE * tint:g}" for tint in (1.0, 0.98, 0.94))
    texts = {
        "scene.xml": _SCENE.format(shapes=shapes, light=light),
        "routes.json": json.dumps(routes(), indent=1) + "\n",
    }
    return files + write_texts(folder, texts)


def main() -> None:
    """Parse the arguments and build."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    arguments = parser.parse_args()
    for path in build(arguments.out, arguments.seed):
        print(path)


if __name__ == "__main__":
    main()
