"""Objects that the rule of training puts at the roadside of a grid's routes."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.ranges import Facing, NonNegative, Positive, Seed
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.scenario.named_file import File
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.section import Section
from mi_nerfattack.scenario.world import driven_route
from mi_nerfattack.vehicle.route.route import load_routes

_RULE = Roadside()


class DrawSection(Section):
    """Objects at the roadside by the rule of `Roadside`, with one draw per seed."""

    fields: Annotated[tuple[File, ...], Field(min_length=1)]
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)] | None = None  # the cell's
    scales: tuple[tuple[Positive, Positive], ...] = _RULE.scales
    gap_m: tuple[NonNegative, NonNegative] = _RULE.gap_m
    clearance_m: NonNegative = _RULE.clearance_m
    facing: Facing = _RULE.facing

    def rule(self) -> Roadside:
        """Make the rule.

        Raises:
            InputError: a range ends before it begins.
        """
        return replace(
            _RULE,
            scales=self.scales,
            gap_m=self.gap_m,
            clearance_m=self.clearance_m,
            facing=self.facing,
        )


class Places:
    """What draws places, and keeps the scenes and objects that it loaded."""

    def __init__(self) -> None:
        self._surroundings = functools.cache(_surroundings)
        self._field = functools.cache(load_grid)

    def draw(
        self, section: DrawSection, seed: int, scenario: Scenario
    ) -> list[dict[str, Any]]:
        """Draw places at the roadside for the objects of a scenario.

        Args:
            section: what is drawn.
            seed: of the draw; each route has different random numbers.
            scenario: gives deployment scene, routes, drive, vehicle and camera.

        Returns:
            the keys of each object in a scenario.

        Raises:
            InputError: a file is missing or wrong, or no place was found for all.
        """
        vehicle, scene, rig = scenario.vehicle, scenario.scene, scenario.rig()
        route = driven_route(scenario, vehicle.motion())
        around = self._surroundings(
            scene.deployment.file,
            scene.routes.file,
            rig.cameras[0],
            rig.mounts[0],
            vehicle.dt_s,
        )
        poses = section.rule().draw(
            [self._field(item.file) for item in section.fields],
            around,
            route,
            scenario.drive.stretch(route, vehicle.dt_s),
            np.random.default_rng([seed, *route.name.encode()]),
        )
        return [
            {
                "id": f"object{number}",
                "field": item.portable,
                "position_m": [round(float(x), 4) for x in pose.translation],
                "yaw_deg": round(float(np.degrees(pose.yaw)), 4),
                "scale": round(float(pose.scale), 6),
            }
            for number, (item, pose) in enumerate(
                zip(section.fields, poses, strict=True), start=1
            )
        ]


def _surroundings(
    scene: Path, routes: Path, camera: Camera, mount: CameraMount, period: float
) -> Surroundings:
    return Surroundings(
        load_scene(scene), load_routes(routes), camera, mount=mount, period=period
    )
