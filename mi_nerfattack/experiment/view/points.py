"""A scene as points: what a camera on the route sees of the surrogate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.registry import kinematic_vehicle
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.deploy.views.above import PixelRays
from mi_nerfattack.scenario.world import World

APART_M = 4.0  # between the places that are looked around from
FARTHEST_M = 60.0
CELL_M = 0.1
SAME = 0.05  # of a depth, by which its neighbours may differ
MOST = 200_000


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with colours.

    Attributes:
        points: (n, 3), metres.
        colours: (n, 3), uint8, sRGB.
    """

    points: np.ndarray
    colours: np.ndarray


def scene_cloud(
    world: World,
    states: np.ndarray,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> Cloud:
    """Look around along a drive, and put a point where each pixel's ray ends.

    The surrogate without objects, through the drives' own camera, turned to four sides
    at places `APART_M` apart: a point lies at the expected depth of a ray that meets
    at least half an opacity. What no such ray meets is not there.
    Cost: four frames a place.

    Args:
        world: of the run.
        states: (n, 3) of a drive, metres and radians.
        on_frame: called with frames done and all frames.
    """
    sensor = world.without_objects().through(0)
    environment = SurrogateEnvironment(sensor, kinematic_vehicle(world.place))
    rays, clouds = PixelRays(sensor.intrinsics), []
    places = _places(states)
    for number, pose in enumerate(places, start=1):
        clouds.append(frame_points(environment.reset(world.route, pose), rays))
        on_frame(number, len(places))
    points = np.concatenate([cloud.points for cloud in clouds])
    colours = np.concatenate([cloud.colours for cloud in clouds])
    return thinned(Cloud(points, colours))


def frame_points(frame: CameraFrame, rays: PixelRays) -> Cloud:
    """Put a point where each pixel's ray ends.

    Left out where the depth is beyond `FARTHEST_M`, or another than around it: at an
    edge, where a ray that meets two things ends between them.

    Args:
        frame: of any environment.
        rays: of its camera.
    """
    pose = frame.camera_to_world
    depth = np.minimum(frame.depth.astype(np.float64), 2 * FARTHEST_M)
    apart = np.abs(depth - ndimage.median_filter(depth, 3, mode="nearest"))
    mask = (depth < FARTHEST_M) & (apart < SAME * depth)
    along = rays.at(pose).direction.numpy().T.reshape(*depth.shape, 3)[mask]
    points = pose[:3, 3] + along * depth[mask][:, None]
    return Cloud(points, frame.image[mask])


def thinned(cloud: Cloud, cell_m: float = CELL_M, most: int = MOST) -> Cloud:
    """Keep the first point of each cell; in larger cells where there are too many.

    Args:
        cloud: many points.
        cell_m: edge of a cell, metres.
        most: points that are kept.
    """
    while True:
        cells = np.floor(cloud.points / cell_m).astype(np.int64)
        _, first = np.unique(cells, axis=0, return_index=True)
        if len(first) <= most:
            first.sort()
            return Cloud(cloud.points[first], cloud.colours[first])
        cell_m *= 1.5


def _places(states: np.ndarray) -> np.ndarray:
    """Choose poses (m, 3) along a drive, four headings a place."""
    steps = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1)
    passed = np.concatenate([[0.0], np.cumsum(steps)])
    distances = np.arange(0.0, passed[-1] + APART_M, APART_M)
    chosen = np.unique(np.searchsorted(passed, distances).clip(max=len(states) - 1))
    places = np.repeat(states[chosen], 4, axis=0)
    places[:, 2] += np.tile(np.arange(4) * np.pi / 2, len(chosen))
    return places
