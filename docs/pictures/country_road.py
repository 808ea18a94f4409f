"""Draw the country road from above and from the driver's place."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
from images import write_jpeg
from PIL import Image

from mi_nerfattack.deploy import Conditions, bundled_place, make_environment
from mi_nerfattack.render import from_fov
from mi_nerfattack.scenes.country.build import build
from mi_nerfattack.vehicle import load_routes

SEED = 4
GAP_PX = 6
#: Route and arc length of each view from the driver's place, metres.
VIEWS = (("out", 36.0), ("back", 62.0))


def draw_country(folder: Path, small: bool) -> None:
    """Build the place, and render its overview above two views along its routes.

    Args:
        folder: where `country.jpg` goes.
        small: render few rays of a small image.
    """
    width, height, spp = (122, 60, 4) if small else (600, 300, 64)
    with tempfile.TemporaryDirectory() as scratch:
        built = Path(scratch)
        build(built, SEED)
        scene = mi.load_file(
            str(built / "scene.xml"),
            spp=spp,
            width=2 * width + GAP_PX,
            height=2 * height,
        )
        above = np.array(mi.util.convert_to_bitmap(mi.render(scene)))[..., :3]
        place = replace(
            bundled_place(),
            scene=built / "scene.xml",
            routes=built / "routes.json",
            field=None,
            camera=from_fov(width, height, 90.0),
        )
        environment = make_environment("mitsuba", place, Conditions(spp=spp))
        images = []
        for name, arc in VIEWS:
            [route] = load_routes(place.routes, [name])
            images.append(environment.reset(route, route.pose_at(arc)).image)
        environment.close()
    gap = np.full((height, GAP_PX, 3), 255, np.uint8)
    below = np.concatenate([images[0], gap, images[1]], axis=1)
    gap = np.full((GAP_PX, below.shape[1], 3), 255, np.uint8)
    picture = np.concatenate([above, gap, below])
    write_jpeg(folder / "country.jpg", Image.fromarray(picture))
