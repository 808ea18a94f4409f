"""Write the intersection: scene.xml, meshes, textures and routes.json.

Run ``python -m mi_nerfattack.scenes.intersection.build [--seed N] [--out FOLDER]``.
The same seed gives the same bytes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from .city import BUILDINGS, build_city
from .facades import paint_atlas
from .furniture import furnish
from .ground import grass, pavement, roads
from .layout import routes
from .mesh import MeshBuilder
from .paint import grass_image, pavement_image, road_images, write_png

SHAPE = """    <shape type="ply" id="{name}">
        <string name="filename" value="meshes/{name}.ply"/>
        <bsdf type="twosided">
            <bsdf type="diffuse">
                <texture type="bitmap" name="reflectance">
                    <string name="filename" value="textures/{name}.png"/>
                    <string name="wrap_mode" value="{wrap}"/>
                </texture>
            </bsdf>
        </bsdf>
    </shape>
"""

_SCENE = """<!-- T-intersection: metres, z up, linear image needs no exposure. -->
<scene version="3.0.0">
    <default name="spp" value="16"/>
    <default name="width" value="600"/>
    <default name="height" value="400"/>

    <integrator type="path">
        <integer name="max_depth" value="4"/>
        <integer name="rr_depth" value="2"/>
    </integrator>

    <sensor type="perspective" id="overview">
        <float name="fov" value="60"/>
        <transform name="to_world">
            <lookat origin="-30, -48, 34" target="4, -6, 0" up="0, 0, 1"/>
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

    <emitter type="sunsky" id="sky">
        <vector name="sun_direction" value="-0.44, -0.50, 0.75"/>
        <float name="turbidity" value="4"/>
        <float name="sun_scale" value="2.5"/>
        <float name="sky_scale" value="3.0"/>
    </emitter>

{shapes}</scene>
"""


def build(folder: Path, seed: int) -> list[Path]:
    """Write the scene below folder and return the files written."""
    meshes = roads() | {
        "pavement": pavement(),
        "grass": grass(),
        "city": build_city(seed, furnish),
    }
    images = road_images(seed) | {
        "pavement": pavement_image(seed),
        "grass": grass_image(seed),
        "city": paint_atlas([b.facade for b in BUILDINGS], seed),
    }
    files = write_parts(folder, meshes, images)
    shapes = "".join(
        SHAPE.format(
            name=name, wrap="repeat" if name in ("pavement", "grass") else "clamp"
        )
        for name in meshes
    )
    texts = {
        "scene.xml": _SCENE.format(shapes=shapes),
        "routes.json": json.dumps(routes(), indent=1) + "\n",
    }
    return files + write_texts(folder, texts)


def write_parts(
    folder: Path, meshes: dict[str, MeshBuilder], images: dict[str, np.ndarray]
) -> list[Path]:
    """Write meshes/NAME.ply and textures/NAME.png, and return the files written.

    Args:
        folder: made if needed.
        meshes: by name.
        images: (h, w, 3) by the same names, sRGB in [0, 1].
    """
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "textures").mkdir(exist_ok=True)
    files = []
    for name, mesh in meshes.items():
        files.append(folder / "meshes" / f"{name}.ply")
        mesh.write_ply(files[-1])
        files.append(folder / "textures" / f"{name}.png")
        write_png(files[-1], images[name])
    return files


def write_texts(folder: Path, texts: dict[str, str]) -> list[Path]:
    """Write texts below a folder by file name, and return the files written."""
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in texts]


def main() -> None:
    """Parse the arguments and build."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    arguments = parser.parse_args()
    for path in build(arguments.out, arguments.seed):
        print(path)


if __name__ == "__main__":
    main()
