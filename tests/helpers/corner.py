"""A corner of a room in photographs: a floor and two walls with grey noise."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at

CAMERA = from_fov(240, 180, 60.0)


def noise(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey noise with detail at several scales, in [0, 1]."""
    total = np.zeros_like(x)
    for level in range(1, 6):
        table = rng.random((64, 64))
        u, v = x * 1.3 * 2**level, y * 1.3 * 2**level
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = u - i, v - j
        corners = [
            [table[(i + di) % 64, (j + dj) % 64] for dj in (0, 1)] for di in (0, 1)
        ]
        (low, high), (low_next, high_next) = corners
        total += (1 - a) * ((1 - b) * low + b * high) / 2**level
        total += a * ((1 - b) * low_next + b * high_next) / 2**level
    return np.clip((total - 0.2) / 0.6, 0, 1)


def corner_photograph(pose: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Trace a floor z = 0 and two walls x = 3, y = 3, seen from inside."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    local = [x, y, np.ones_like(u)]
    ray = np.stack(local, -1) @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore"):
        t = (np.array([3.0, 3.0, 0.0]) - eye) / ray
    t = np.where(t > 1e-9, t, np.inf)
    face = t.argmin(-1)
    point = eye + t.min(-1)[..., None] * ray
    rng = np.random.default_rng(5)
    grey = np.zeros(u.shape)
    for axis in range(3):
        a, b = np.delete(np.arange(3), axis)
        grey += (face == axis) * noise(rng, point[..., a], point[..., b])
    return np.repeat(np.round(255 * grey).astype(np.uint8)[..., None], 3, axis=2)


def corner_poses(count: int = 8) -> np.ndarray:
    angle = np.linspace(-0.5, 0.5, count)
    eyes = np.stack(
        [2 - 4 * np.cos(angle + 0.785), 2 - 4 * np.sin(angle + 0.785), 1.6 + angle], 1
    )
    return np.stack([look_at(eye, np.array([2.2, 2.2, 1.2])) for eye in eyes])


def aligned(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a similarity of points (n, 3); return it applied, and its rotation."""
    centre, target = found.mean(0), given.mean(0)
    u, s, vt = np.linalg.svd((given - target).T @ (found - centre))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / ((found - centre) ** 2).sum()
    return scale * (found - centre) @ turn.T + target, turn
