"""The ground of a Mitsuba scene under a route: cars drive on the plane z = 0."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.vehicle.route.route import Route

#: How far the ground may lie above or below z = 0, metres.
LEVEL_M = 0.3

_EVERY_M = 0.5
_BONNET_M = 1.0  # where a car meets what stands in its way


def vertical_reach(
    scene: Any, points: np.ndarray, from_m: float, up: bool = False
) -> np.ndarray:
    """Return how far (n,) the first surface is below points or above; inf for none.

    Args:
        scene: `mi.Scene`.
        points: (n, 2), metres.
        from_m: height of the points, metres.
        up: look upwards.
    """
    x, y = upload_rows(mi.Point2f, points)
    ray = mi.Ray3f(mi.Point3f(x, y, from_m), mi.Vector3f(0, 0, 1 if up else -1))
    return scene.ray_intersect_preliminary(ray, coherent=False).t.numpy()


def arc_lengths(start: float, end: float) -> np.ndarray:
    """Return places along a route (n,) where the ground is looked for, metres."""
    return np.linspace(start, end, max(2, int((end - start) / _EVERY_M) + 1))


def ground_findings(
    route: Route, arc: np.ndarray, scene: Any, name: str
) -> Iterator[str]:
    """Tell of a route without ground at z = 0 beneath.

    Args:
        route: whose points are the middle of the lane.
        arc: (n,) places along it, metres.
        scene: `mi.Scene`, z up.
        name: of its file.
    """
    points = route.pose_at(arc)[:, :2]
    height = _ground(scene, route, arc)
    missing = ~np.isfinite(height)
    beside = np.pad(missing, 1)
    if (missing & (beside[:-2] | beside[2:])).any():  # not a seam, or the rim
        low, high = (
            np.array(corner) for corner in (scene.bbox().min, scene.bbox().max)
        )
        yield (
            f"route {route.name!r} has no ground beneath it in {name} "
            f"{stretches(arc, missing)}: it runs there from {_ends(points[missing])}, "
            f"and the scene's surfaces lie within x {low[0]:.4g} to {high[0]:.4g}, y "
            f"{low[1]:.4g} to {high[1]:.4g}, z {low[2]:.4g} to {high[2]:.4g} m; scale, "
            "turn or move routes or scene (metres, z up)"
        )
    off = ~missing & (np.abs(height) > LEVEL_M)
    if off.any():
        where = "above" if np.median(height[off]) > 0 else "below"
        yield (
            f"the ground of {name} lies {np.abs(height[off]).max():.2f} m {where} "
            f"z = 0 under route {route.name!r} {stretches(arc, off)}, and cars "
            "drive at z = 0; move the scene along z, or choose a level route"
        )


def wall_findings(
    route: Route, arc: np.ndarray, scene: Any, name: str
) -> Iterator[str]:
    """Tell of a route with a surface across it, as `ground_findings`."""
    points = route.pose_at(arc)[:, :2]
    at = np.column_stack([points, np.full(len(points), _BONNET_M)])
    start, step = at[:-1], np.diff(at, axis=0)
    ray = mi.Ray3f(upload_rows(mi.Point3f, start), upload_rows(mi.Vector3f, step))
    t = scene.ray_intersect_preliminary(ray, coherent=False).t.numpy()
    met = t <= 1.01  # one that begins on a surface would miss it
    if met.any():
        k = int(met.argmax())
        x, y = points[k].round(1) + 0
        yield (
            f"route {route.name!r} runs through a surface of {name} after "
            f"{arc[k]:.1f} m along it, at ({x:g}, {y:g}) m; scale or move routes or "
            "scene (metres)"
        )


def stretches(arc: np.ndarray, marked: np.ndarray) -> str:
    """Say from where to where places along a route are marked."""
    first, last = arc[marked][0], arc[marked][-1]
    share = 100 * marked.mean()
    return f"from {first:.1f} to {last:.1f} m along it ({share:.0f} % of the drive)"


def _ground(scene: Any, route: Route, arc: np.ndarray) -> np.ndarray:
    """Return the height (n,) of what cars stand on, NaN where a side has none.

    It is looked for under both sides of the lane: its middle may lie in an upright
    plane, as in scenes with another axis up.
    """
    sides = []
    for side in (-0.25, 0.25):
        points = route.pose_at(arc, side * route.lane_width_m)[:, :2]
        below = _BONNET_M - vertical_reach(scene, points, _BONNET_M)
        above = _BONNET_M + vertical_reach(scene, points, _BONNET_M, up=True)
        height = np.where(np.isfinite(below), below, above)
        sides.append(np.where(np.isfinite(height), height, np.nan))
    right, left = sides
    return np.where(np.abs(right) < np.abs(left), left, right) + 0 * left


def _ends(points: np.ndarray) -> str:
    (x, y), (u, v) = points[0].round(1) + 0, points[-1].round(1) + 0
    return f"({x:g}, {y:g}) to ({u:g}, {v:g}) m"
