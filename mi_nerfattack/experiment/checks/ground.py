"""Whether route, scene and field lie where the car drives: on the plane z = 0."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.views.rays import PixelRays, vertical_reach
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.world import World

#: How far the ground may lie above or below z = 0, metres.
LEVEL_M = 0.3
#: Share by which depths of surrogate and deployment may differ in the middle.
DEPTHS = 0.15

_EVERY_M = 0.5
_BONNET_M = 1.0  # where a car meets what stands in its way
_STANDING_M = 0.5  # what is higher above z = 0 is no ground
_FARTHEST_M = 80.0
_FEWEST = 100  # pixels, of which something is said


def driven_points(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return arc lengths (n,) and points (n, 2), metres, of the driven lane centre."""
    route, scenario = world.route, world.scenario
    start, end = scenario.drive.stretch(route, scenario.vehicle.dt_s)
    arc = np.linspace(start, end, max(2, int((end - start) / _EVERY_M) + 1))
    return arc, route.pose_at(arc)[:, :2]


def ground_findings(world: World, scene: Any, name: str) -> Iterator[str]:
    """Tell of a route without ground at z = 0 beneath, or with a wall on it.

    Args:
        world: gives the driven part of the route.
        scene: `mi.Scene`, z up.
        name: of its file.
    """
    arc, points = driven_points(world)
    height = _ground(scene, points)
    missing = ~np.isfinite(height)
    beside = np.pad(missing, 1)
    if (missing & (beside[:-2] | beside[2:])).any():  # not a seam, or the rim
        low, high = (
            np.array(corner) for corner in (scene.bbox().min, scene.bbox().max)
        )
        yield (
            f"route {world.route.name!r} has no ground beneath it in {name} "
            f"{_stretches(arc, missing)}: it runs there from {_told(points[missing])}, "
            f"and the scene's surfaces lie within x {low[0]:.4g} to {high[0]:.4g}, y "
            f"{low[1]:.4g} to {high[1]:.4g} m; scale or move routes or scene (metres)"
        )
    off = ~missing & (np.abs(height) > LEVEL_M)
    if off.any():
        where = "above" if np.median(height[off]) > 0 else "below"
        yield (
            f"the ground of {name} lies {np.abs(height[off]).max():.2f} m {where} "
            f"z = 0 under route {world.route.name!r} {_stretches(arc, off)}, and cars "
            "drive at z = 0; move the scene along z, or choose a level route"
        )
    if (k := _first_wall(scene, points)) is not None:
        x, y = points[k].round(1) + 0
        yield (
            f"route {world.route.name!r} runs through a surface of {name} after "
            f"{arc[k]:.1f} m along it, at ({x:g}, {y:g}) m; scale or move routes or "
            "scene (metres)"
        )


def box_findings(world: World) -> Iterator[str]:
    """Tell of a route that leaves the box of the surrogate's field."""
    arc, points = driven_points(world)
    objects = world.surrogate.objects
    layers = [item for item in world.surrogate.layers if item not in objects]
    if len(layers) != 1 or not isinstance(layers[0], PosedField):
        return
    field, pose = layers[0].field, layers[0].placed
    inside = np.column_stack(
        [points, np.full(len(points), world.surrogate.mount.height_m)]
    )
    local = pose.to_local(inside)
    out = np.any((local < field.lower) | (local > field.upper), axis=1)
    if out.any():
        size = pose.scale * (field.upper - field.lower)
        place = world.scenario.scene
        yield (
            f"the camera leaves the box of {place.field or place.surrogate}, of "
            f"{size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} m, "
            f"{_stretches(arc, out)} of route {world.route.name!r}: nothing is shown "
            "there; give a field of this place, or its scene.to_world"
        )


def likeness_findings(
    camera: Camera, surrogate: CameraFrame, deployment: CameraFrame, label: str
) -> Iterator[str]:
    """Tell of two worlds whose standing things are at other distances.

    Args:
        camera: of both frames.
        surrogate: its frame.
        deployment: another's, from the same pose.
        label: of the deployment.
    """
    pose = deployment.camera_to_world
    upwards = PixelRays(camera).at(pose).direction.z.numpy()
    ours, theirs = surrogate.depth, deployment.depth
    with np.errstate(invalid="ignore"):
        height = pose[2, 3] + theirs * upwards.reshape(theirs.shape)
        standing = height > _STANDING_M
    seen = standing & np.isfinite(ours) & (theirs < _FARTHEST_M)
    if seen.sum() < _FEWEST:
        return
    change = float(np.median(np.abs(np.log(ours[seen] / theirs[seen]))))
    if change > np.log1p(DEPTHS):
        yield (
            f"surrogate and {label} do not show one place: at the start, half of what "
            f"stands there is {100 * np.expm1(change):.0f} % or more nearer or farther "
            f"in one than in the other ({np.median(ours[seen]):.1f} and "
            f"{np.median(theirs[seen]):.1f} m in the middle); compare their pictures, "
            "and correct the field's scene.to_world"
        )


def _ground(scene: Any, points: np.ndarray) -> np.ndarray:
    """Return the height (n,) of what cars stand on at points (n, 2); NaN for none."""
    below = _BONNET_M - vertical_reach(scene, points, _BONNET_M)
    above = _BONNET_M + vertical_reach(scene, points, _BONNET_M, up=True)
    found = np.where(np.isfinite(below), below, above)
    return np.where(np.isfinite(found), found, np.nan)


def _first_wall(scene: Any, points: np.ndarray) -> int | None:
    """Return the first of points (n, 2) after which a surface is in the way."""
    at = np.column_stack([points, np.full(len(points), _BONNET_M)])
    start, step = at[:-1], np.diff(at, axis=0)
    ray = mi.Ray3f(upload_rows(mi.Point3f, start), upload_rows(mi.Vector3f, step))
    t = scene.ray_intersect_preliminary(ray, coherent=False).t.numpy()
    met = t <= 1.01  # one that begins on a surface would miss it
    return int(met.argmax()) if met.any() else None


def _stretches(arc: np.ndarray, marked: np.ndarray) -> str:
    first, last = arc[marked][0], arc[marked][-1]
    share = 100 * marked.mean()
    return f"from {first:.1f} to {last:.1f} m along it ({share:.0f} % of the drive)"


def _told(points: np.ndarray) -> str:
    (x, y), (u, v) = points[0].round(1) + 0, points[-1].round(1) + 0
    return f"({x:g}, {y:g}) to ({u:g}, {v:g}) m"
