"""Write the country road: scene.xml, meshes, textures and routes.json.

Run ``python -m mi_nerfattack.scenes.country.build -o FOLDER [--seed N]``. The same seed
gives the same bytes.
"""

# The rule of this place: it is used once. No setting of a training, an attack or an
# environment is chosen here. A study settles them at other places and then trains and
# measures here, one time. So its results do not rest on one town.

from __future__ import annotations

from pathlib import Path

from ..atlas import paint_atlas
from ..place import main, scene_xml, sun_and_sky, write_place
from ..scenery import Scenery
from .farm import BARN, HOUSE, furnish
from .ground import hills, road
from .layout import routes
from .paint import ground_image, leaves_image, road_image
from .plants import plant


def build(folder: Path, seed: int) -> list[Path]:
    """Write the scene below folder and return the files written."""
    facades = [HOUSE.facade, BARN.facade]
    scenery = Scenery(seed, len(facades))
    furnish(scenery, seed)
    leaves = plant(seed, scenery)
    meshes = {
        "road": road(),
        "ground": hills(seed),
        "leaves": leaves,
        "farm": scenery.mesh,
    }
    images = {
        "road": road_image(seed),
        "ground": ground_image(seed),
        "leaves": leaves_image(seed),
        "farm": paint_atlas(facades, seed),
    }
    scene = scene_xml(
        "Country road: metres, z up, linear image needs no exposure.",
        fov="60",
        lookat='origin="-20, -56, 62" target="-6, 2, 0" up="0, 0, 1"',
        lights=sun_and_sky("0.36, -0.52, 0.77"),
        wraps=dict.fromkeys(meshes, "clamp"),
    )
    return write_place(
        folder, meshes=meshes, images=images, scene=scene, routes=routes()
    )


if __name__ == "__main__":
    main(__doc__, build, seed=4)
