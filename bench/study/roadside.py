"""The rule by which studies put one object beside a lane; protocols rest on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.vehicle.route.route import Route

#: Height of the ground (n,), metres, at points (n, 2); NaN where nothing can stand.
Ground = Callable[[np.ndarray], np.ndarray]

_TRIES = 64
_HALF_CAR_M = 0.9


@dataclass(frozen=True)
class Roadside:
    """Sizes and positions of objects beside a route.

    Args:
        height_m: range of the object's height, metres.
        lateral_m: range of its distance from the lane centre, metres; the lower end
            grows for objects so wide that they would reach into the car's way.
        clearance_m: between the car's side and the object's bounding circle, metres.
    """

    height_m: tuple[float, float] = (1.0, 2.5)
    lateral_m: tuple[float, float] = (2.0, 5.0)
    clearance_m: float = 0.2

    def draw(
        self,
        field: GridField,
        route: Route,
        arc: tuple[float, float],
        ground: Ground,
        rng: np.random.Generator,
    ) -> Pose:
        """Draw a pose on the ground beside a route, on either side.

        Args:
            field: upright in its frame, standing on z = 0.
            route: that the object keeps clear of, everywhere.
            arc: range of the arc length beside which it stands, metres.
            ground: height of the ground.
            rng: source of all draws.

        Raises:
            InputError: no free ground found.
        """
        scale = rng.uniform(*self.height_m, _TRIES) / field.upper[2]
        corner = np.maximum(np.abs(field.lower[:2]), np.abs(field.upper[:2]))
        reach = scale * np.hypot(*corner) + _HALF_CAR_M + self.clearance_m
        nearest = np.maximum(self.lateral_m[0], reach)
        farthest = np.maximum(self.lateral_m[1], nearest + 1)
        side = rng.choice([-1.0, 1.0], _TRIES)
        lateral = side * rng.uniform(nearest, farthest)
        poses = route.pose_at(rng.uniform(*arc, _TRIES), lateral)
        height = ground(poses[:, :2])
        distance = np.abs(route.cross_track_numpy(poses))
        free = np.isfinite(height) & (distance > nearest - 1e-3)
        yaw = float(rng.uniform(-np.pi, np.pi))
        if not free.any():
            raise InputError(
                f"route {route.name!r}: no free ground beside it at {arc[0]:.1f} to "
                f"{arc[1]:.1f} m, {self.lateral_m} m aside; move routes or obstacles"
            )
        i = int(np.argmax(free))
        x, y = poses[i, :2].tolist()
        return Pose.upright((x, y, float(height[i])), yaw, float(scale[i]))


def scene_ground(scene: Any, highest_m: float = 0.3) -> Ground:
    """Return the ground of a Mitsuba scene with z up; of a room, below its ceiling.

    Args:
        scene: `mi.Scene`.
        highest_m: what is higher, or has no surface, counts as occupied, metres.
    """
    box = scene.bbox()
    sides = [np.linspace(box.min[i], box.max[i], 18)[1:-1] for i in range(2)]
    seen = _first_below(scene, np.stack(np.meshgrid(*sides), -1).reshape(-1, 2), 100.0)
    # a ceiling is above all of it
    top = float(seen.min()) - 0.1 if seen.min() > highest_m else 100.0

    def height(points: np.ndarray) -> np.ndarray:
        z = _first_below(scene, points, top)
        return np.where(np.isfinite(z) & (z < highest_m), z, np.nan)

    return height


def _first_below(scene: Any, points: np.ndarray, top: float) -> np.ndarray:
    """Return the first surface (n,) below a height at points (n, 2); -inf for none."""
    x, y = upload_rows(mi.Point2f, points[:, :2])
    ray = mi.Ray3f(mi.Point3f(x, y, top), mi.Vector3f(0, 0, -1))
    return top - scene.ray_intersect_preliminary(ray, coherent=False).t.numpy()
