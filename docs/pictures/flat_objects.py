"""Draw a billboard and a patch, as the policy sees them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from images import write_jpeg
from PIL import Image

from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world

SCENARIO = Path(__file__).resolve().parents[1] / "examples/flat.toml"
ARC_M = 23.0  # of the car along the route
GAP_PX = 6


def draw_flat(folder: Path, small: bool) -> None:
    """Render the surrogate above the deployment, whose scene lights the objects.

    Args:
        folder: where `flat.jpg` goes.
        small: render few rays of a small image.
    """
    width, height, spp = (96, 48, 1) if small else (640, 240, 16)
    settings = [f"camera.width={width}", f"camera.height={height}"]
    settings += [f"scene.spp={spp}", f"deployment.spp={8 * spp}"]
    scenario, _ = load_scenario(SCENARIO, settings=settings)
    world = build_world(scenario, scenario.build_policy())
    images = []
    for label in world.labels:
        environment = world.open(label)
        frame = environment.reset(world.route, world.route.pose_at(ARC_M), 0)
        images.append(frame.image)
    gap = np.full((GAP_PX, width, 3), 255, np.uint8)
    picture = np.concatenate([images[0], gap, images[1]])
    write_jpeg(folder / "flat.jpg", Image.fromarray(picture))
