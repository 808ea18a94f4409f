"""Write the intersection: scene.xml, meshes, textures and routes.json.

Run ``python -m mi_nerfattack.scenes.intersection.build [--seed N] [--out FOLDER]``.
The same seed gives the same bytes.
"""

from __future__ import annotations

from pathlib import Path

from ..atlas import paint_atlas
from ..place import main, scene_xml, sun_and_sky, write_place
from .city import BUILDINGS, build_city
from .furniture import furnish
from .ground import grass, pavement, roads
from .layout import routes
from .paint import grass_image, pavement_image, road_images


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
    repeated = ("pavement", "grass")
    scene = scene_xml(
        "T-intersection: metres, z up, linear image needs no exposure.",
        fov="60",
        lookat='origin="-30, -48, 34" target="4, -6, 0" up="0, 0, 1"',
        lights=sun_and_sky("-0.44, -0.50, 0.75"),
        wraps={name: "repeat" if name in repeated else "clamp" for name in meshes},
    )
    return write_place(
        folder, meshes=meshes, images=images, scene=scene, routes=routes()
    )


if __name__ == "__main__":
    main(__doc__, build, seed=3, folder=Path(__file__).parent)
