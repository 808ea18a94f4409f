"""Analytic pictures and depths of a room with far walls, and a field solid in cells."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from helpers.sphere_views import world_rays

from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.fields import AbstractField, Occupancy
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

HALF, HEIGHT = 25.0, 12.0  # metres
BOX = np.array([-34.0, -34.0, -2.0]), np.array([34.0, 34.0, 14.0])
_OFFSET = 14.0  # of the cameras, so that walls are up to 50 m away
_SKY = 150  # sRGB


def room_views(
    count: int, turn: float = 0.0, seed: int = 0, size: tuple[int, int] = (96, 48)
) -> tuple[PosedImages, np.ndarray]:
    """Ray trace four walls and a floor under a grey sky; return depths too.

    Args:
        count: number of views.
        turn: of the walls against the axes, radians.
        seed: of the views.
        size: width and height, pixels.
    """
    width, height = size
    rng = np.random.default_rng(seed)
    camera = from_fov(width, height, 90.0)
    images = np.full((count, height, width, 3), _SKY, np.uint8)
    depth = np.full((count, height, width), np.inf, np.float32)
    poses = np.empty((count, 4, 4))
    for i in range(count):
        x, y = rng.uniform(-_OFFSET, _OFFSET, 2)
        heading = rng.uniform(-np.pi, np.pi)
        ahead = [x + np.cos(heading), y + np.sin(heading), 1.4]
        poses[i] = look_at(np.array([x, y, 1.5]), ahead)
        ray = world_rays(camera, poses[i])
        t = _distances(poses[i, :3, 3], ray, turn)
        hit = np.isfinite(t)
        depth[i] = t
        point = poses[i, :3, 3] + t[hit][:, None] * ray[hit]
        images[i][hit] = 255 * (0.5 + 0.3 * np.sin(0.4 * point))
    return PosedImages(images, poses, camera, tuple(map(str, range(count)))), depth


def _distances(eye: np.ndarray, ray: np.ndarray, turn: float) -> np.ndarray:
    """Return the distances of walls and floor along rays (..., 3)."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    o, d = rotation @ eye, ray @ rotation.T
    with np.errstate(divide="ignore"):
        wall = ((np.sign(d) * HALF - o) / d)[..., :2].min(-1)
        floor = np.where(d[..., 2] < 0, -o[2] / d[..., 2], np.inf)
    wall = np.where(o[2] + wall * d[..., 2] < HEIGHT, wall, np.inf)
    return np.minimum(wall, floor)


def shell_cells(shape: tuple[int, int, int], layers: int) -> np.ndarray:
    """Mark the cells in which the walls (unturned) and the floor lie, and some behind.

    Args:
        shape: of a grid over `BOX`.
        layers: of cells, at least 1.
    """
    cells = np.zeros(shape, bool)
    scale = np.array(shape) / (BOX[1] - BOX[0])
    faces = np.array([[-HALF, -HALF, 0.0], [HALF, HALF, HEIGHT]])
    low, high = np.floor((faces - BOX[0]) * scale).astype(int)
    more = layers - 1
    x, y, z = (slice(a - more, b + more + 1) for a, b in zip(low, high, strict=True))
    cells[x, y, z.start : high[2] + 1] = True
    cells[low[0] + 1 : high[0], low[1] + 1 : high[1], low[2] + 1 :] = False
    return cells


class SolidField(AbstractField):
    """Opaque and grey in the cells of its occupancy."""

    kind = "solid"

    def __init__(self, step_m: float, cone: float) -> None:
        self.lower, self.upper = BOX
        self.step_m, self.cone = step_m, cone
        self.occupy(Occupancy.full())

    def eval_everywhere(
        self, point: Any, direction: Any, active: Any
    ) -> tuple[Any, Any]:
        """Evaluate density and colour."""
        return mi.Float(1e4) & active, mi.Color3f(0.2) & active
