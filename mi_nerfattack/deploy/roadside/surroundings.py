"""A scene and its routes, as the rule sees them: ground, kerbs, walls, a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.deploy.roadside.footprint import Stands, points_along
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix
from mi_nerfattack.render.pathtrace.ground import vertical_reach
from mi_nerfattack.vehicle.route.route import Route

#: What is higher, or has no surface, counts as occupied, metres.
HIGHEST_M = 0.3
#: Ground that is so much higher than the lane lies beyond a kerb, metres.
KERB_M = (0.05, 0.2)
#: How uneven the ground under an object may be, metres.
_FLAT_M = 0.04
#: Share of the lines across a route that meet a kerb where the route has kerbs.
_KERBED = 0.25


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What decides where objects can stand and from where they are seen.

    Args:
        scene: `mi.Scene` with z up; of a room, its ceiling is above all of it.
        routes: all of the scene: their lanes stay free.
        camera: intrinsics of the vehicle's camera.
        mount: where it sits.
        period: seconds between two images.
    """

    scene: Any
    routes: Sequence[Route]
    camera: Camera
    mount: CameraMount
    period: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the height of the ground, (n,); NaN where something is above it.

        Args:
            points: (n, 2), metres.
        """
        z = self._top - vertical_reach(self.scene, points, self._top)
        return np.where(np.isfinite(z) & (z < HIGHEST_M), z, np.nan)

    def kerb(self, route: Route, arc: np.ndarray, side: np.ndarray) -> np.ndarray:
        """Return how far the road's edge is from a route's centre, (n,), metres.

        The edge is the kerb, which the function looks for up to two lane widths beyond
        the lane. The distance is infinite where there is no kerb. On a route with
        hardly any kerb, the lane's edge is the road's edge.

        Args:
            route: of the lane.
            arc: (n,), metres.
            side: (n,), 1 for the left and -1 for the right.
        """
        known = self._kerbed
        if route.name not in known:
            arcs = np.tile(np.linspace(0, route.length, 64), 2)
            kerbs = self._kerbs(route, arcs, np.repeat([1.0, -1.0], 64))
            known[route.name] = bool(np.isfinite(kerbs).mean() >= _KERBED)
        if not known[route.name]:
            return np.full(len(arc), route.lane_width_m / 2)
        return self._kerbs(route, arc, side)

    def on_lanes(self, points: np.ndarray, gap: float) -> np.ndarray:
        """Tell which boxes have points (n, m, 2) closer than a gap to any lane."""
        flat = np.pad(points.reshape(-1, 2), ((0, 0), (0, 1)))
        near = [
            np.abs(route.cross_track_numpy(flat)) < route.lane_width_m / 2 + gap
            for route in self.routes
        ]
        return np.any(near, axis=0).reshape(points.shape[:2]).any(1)

    def stand_free(self, stands: Stands, step: float, clearance: float) -> np.ndarray:
        """Tell which boxes (n,) stand on even ground, clear of all else of the scene.

        Args:
            stands: the boxes.
            step: metres between rays.
            clearance: metres around the boxes.
        """
        under = stands.lattice(step)
        ground = self.height(under.reshape(-1, 2)).reshape(under.shape[:2])
        flat = np.abs(ground - stands.ground[:, None]).max(1) < _FLAT_M
        around = stands.lattice(step, clearance)
        heights = self.height(around.reshape(-1, 2)).reshape(around.shape[:2])
        free = flat & np.isfinite(heights).all(1)
        free[free] = ~self._crossed(stands[free], step, clearance)
        return free

    def drive(self, route: Route, begin: float, end: float) -> np.ndarray:
        """Return the camera's poses (m, 4, 4) of a drive along a lane's centre.

        Args:
            route: of the lane.
            begin: arc length at the start of the drive, metres.
            end: arc length at the end of the drive, metres.
        """
        step = route.speed_ms * self.period
        arc = begin + step * np.arange(int((end - begin) / step + 1e-6) + 1)
        states = route.pose_at(arc)
        states[:, 2] = route.heading_at(arc)
        return mount_matrix(states, self.mount)

    def visible(self, eyes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Tell which points (n, 3) nothing of the scene hides from eyes (n, 3)."""
        return ~self._hit(eyes, points - eyes, 1 - 1e-3)

    @cached_property
    def _top(self) -> float:
        """Height from which to look down: of a room, below its ceiling."""
        box = self.scene.bbox()
        sides = [np.linspace(box.min[i], box.max[i], 18)[1:-1] for i in range(2)]
        points = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
        heights = 100.0 - vertical_reach(self.scene, points, 100.0)
        return float(heights.min()) - 0.1 if heights.min() > HIGHEST_M else 100.0

    @cached_property
    def _kerbed(self) -> dict[str, bool]:
        """Whether routes have kerbs, by name, as far as it was asked."""
        return {}

    def _kerbs(self, route: Route, arc: np.ndarray, side: np.ndarray) -> np.ndarray:
        across = np.linspace(0.5, 2.5, 41) * route.lane_width_m
        lateral = np.concatenate([[0.0], across])
        points = route.pose_at(arc[:, None], side[:, None] * lateral)[..., :2]
        height = self.height(points.reshape(-1, 2)).reshape(len(arc), -1)
        step = height[:, 1:] - height[:, :1]
        raised = (step > KERB_M[0]) & (step < KERB_M[1])
        return np.where(raised.any(1), across[raised.argmax(1)], np.inf)

    def _crossed(self, stands: Stands, step: float, clearance: float) -> np.ndarray:
        """Tell which boxes (n,) and their clearance a surface reaches into."""
        if not len(stands):
            return np.zeros(0, bool)
        half = stands.half + clearance
        counts = points_along(half, step)
        lines = []
        for axis in (0, 1):
            across = np.linspace(-1, 1, counts[1 - axis])
            ends = np.ones((2, len(across), 2)) * [[[-1.0]], [[1.0]]]
            ends[..., 1 - axis] = across
            lines.append(ends)
        begin, end = np.concatenate(lines, axis=1)
        begin, end = (stands.to_world(unit * half[:, None]) for unit in (begin, end))
        hit = np.zeros(len(stands), bool)
        for level in (0.15, 0.5, 0.95):
            z = (stands.ground + level * stands.height)[:, None, None]
            z = np.broadcast_to(z, (*begin.shape[:2], 1))
            origin, target = (np.concatenate([part, z], -1) for part in (begin, end))
            way = (target - origin).reshape(-1, 3)
            hits = self._hit(origin.reshape(-1, 3), way, 1.0)
            hit |= hits.reshape(begin.shape[:2]).any(1)
        return hit

    def _hit(self, origin: np.ndarray, way: np.ndarray, share: float) -> np.ndarray:
        """Tell which lines (n, 3) meet a surface within a share of their length."""
        length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
        ray = mi.Ray3f(
            upload_rows(mi.Point3f, origin),
            upload_rows(mi.Vector3f, way / length[:, None]),
        )
        ray.maxt = mi.Float((share * length).tolist())
        return self.scene.ray_test(ray, coherent=False).numpy()
