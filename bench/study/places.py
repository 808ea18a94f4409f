"""Where studies put an object: drawn before any result is seen.

Every place is drawn by `roadside.Roadside`, by which objects stood beside lanes in the
training of the bundled policy; the first draw counts, whatever it gives.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from bench.study.roadside import Ground, Roadside, scene_ground
from mi_nerfattack.fields import load_grid
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route

ROUTES = ("straight", "right", "left")
#: The hydrant's own height, metres; objects in studies are as tall, or twice.
NATURAL_M = 0.75


@dataclass(frozen=True)
class Place:
    """An object beside a route.

    Attributes:
        route: name.
        lateral_m: range of the distance from the lane centre, metres.
        arc_m: range of the way from the route's start, metres.
        seed: of the draw.
    """

    route: str
    lateral_m: tuple[float, float]
    arc_m: tuple[float, float]
    seed: int

    def pose(self, height_m: float) -> Pose:
        """Draw the pose of the hydrant, so tall; all heights share the draw's seed."""
        field = load_grid(bundled("hydrant/field.safetensors"))
        route = Route.from_file(bundled("intersection/routes.json"), self.route)
        rule = Roadside(height_m=(height_m, height_m), lateral_m=self.lateral_m)
        seeds = [17, ROUTES.index(self.route), self.seed]
        return rule.draw(
            field, route, self.arc_m, _ground(), np.random.default_rng(seeds)
        )

    def write(self, height_m: float, keys: str, folder: Path, seed: int = 0) -> Path:
        """Write the scenario of an attack here, and return the file.

        Args:
            height_m: of the object.
            keys: further tables, as TOML.
            folder: to write to.
            seed: of the attack.
        """
        pose = self.pose(height_m)
        path = folder / "scenario.toml"
        position = [round(float(v), 4) for v in pose.translation]
        head = _HEAD.format(
            route=self.route,
            position=position,
            yaw=np.degrees(pose.yaw),
            scale=pose.scale,
            seed=seed,
        )
        path.write_text(head + keys, encoding="utf-8")
        return path


_HEAD = """
name = "study"
seed = {seed}

[scene]
field = "bundled:intersection/field.safetensors"
deployment = "bundled:intersection/scene.xml"
routes = "bundled:intersection/routes.json"
route = "{route}"

[[objects]]
id = "hydrant"
field = "bundled:hydrant/field.safetensors"
position_m = {position}
yaw_deg = {yaw:.4f}
scale = {scale:.6f}

[policy]
file = "bundled:policy/pilotnet.safetensors"
"""


@cache
def _ground() -> Ground:
    return scene_ground(load_scene(bundled("intersection/scene.xml")))
