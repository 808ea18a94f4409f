"""Pictures with poses and depths: a sphere, a corner, a far room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.posed_images import PosedImages, stacked
from mi_nerfattack.capture.transforms import begin_posed, write_poses
from mi_nerfattack.fields import AbstractField, GridLayout, NGPLayout, Occupancy
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.distortion import direction
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at
from mi_nerfattack.render.pathtrace.views import iterate_views

SIZE = 24
RADIUS = 0.4
BOX = np.full(3, -0.5), np.full(3, 0.5)
#: One of each kind for all fits: their kernels take seconds to compile.
TINY_GRID, TINY_NGP = GridLayout(4, 4, 16), NGPLayout(4, 2, 10, 4, 32, 16)


def directions(count: int) -> np.ndarray:
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    phi = 2.4 * np.arange(count)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def sphere_colour(normal: np.ndarray) -> np.ndarray:
    return 0.5 + 0.3 * normal


def sphere_views(count: int = 16, alpha: bool = True) -> tuple[PosedImages, np.ndarray]:
    """Ray trace a coloured sphere, over nothing or over a grey sky."""
    camera = from_fov(SIZE, SIZE, 40.0)
    poses = np.stack([look_at(1.6 * d, np.zeros(3)) for d in directions(count)])
    images = np.zeros((count, SIZE, SIZE, 4), np.uint8)
    depth = np.full((count, SIZE, SIZE), np.inf, np.float32)
    for i, pose in enumerate(poses):
        ray = world_rays(camera, pose)
        eye = pose[:3, 3]
        b = ray @ eye
        root = b**2 - eye @ eye + RADIUS**2
        hit = root > 0
        t = -b[hit] - np.sqrt(root[hit])
        depth[i][hit] = t
        colour = sphere_colour((eye + t[:, None] * ray[hit]) / RADIUS)
        images[i][hit, :3] = np.round(255 * colour)
        images[i][hit, 3] = 255
    if not alpha:
        images[images[..., 3] == 0] = 128
        images = images[..., :3]
    names = tuple(f"view {i}" for i in range(count))
    return PosedImages(images, poses, camera, names), depth


def mixed_views(count: int, alpha: bool = True) -> tuple[PosedImages, np.ndarray]:
    """Cut the views of the sphere to several sizes, so that their intrinsics differ."""
    views, depth = sphere_views(count, alpha)
    crops = [np.s_[:, :], np.s_[:, 4:-4], np.s_[3:, :], np.s_[:, 4:-4]] * count
    cut = [a[crop] for a, crop in zip(views.images, crops, strict=False)]
    maps = [a[crop] for a, crop in zip(depth, crops, strict=False)]
    cameras = []
    for own, (rows, columns) in zip(cut, crops, strict=False):
        cx = views.camera.cx - (columns.start or 0)
        cy = views.camera.cy - (rows.start or 0)
        size = {"height": own.shape[0], "width": own.shape[1]}
        cameras.append(replace(views.camera, cx=cx, cy=cy, **size))
    mixed = replace(views, images=stacked(cut), cameras=tuple(cameras))
    return mixed, stacked(maps)


def world_rays(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Unit directions (height, width, 3) of a camera, in NumPy."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    world = np.stack([x, y, np.ones_like(x)], -1) @ pose[:3, :3].T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def write_folder(root: Path, depth: np.ndarray | None) -> PosedImages:
    """Write sphere views as a folder, with a depth file unless None."""
    images, _ = sphere_views(4)
    extra = None if depth is None else {"depth_file": "depth.safetensors"}
    write_transforms(root, images.images, images.camera, images.camera_to_world, extra)
    if depth is not None:
        files.write_safetensors(root / "depth.safetensors", {"depth": depth}, {})
    return images


def write_transforms(
    folder: str | Path,
    images: np.ndarray,
    camera: Camera,
    camera_to_world: np.ndarray,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write images as PNG and their poses as `transforms.json`, whose path is returned.

    The poses (n, 4, 4) are in OpenCV's axes; extra are more keys of the top level.
    """
    names = tuple(f"images/{i:04d}.png" for i in range(len(images)))
    posed = PosedImages(images, np.asarray(camera_to_world, float), camera, names)
    path = begin_posed(folder)
    for name, image in zip(names, posed.images, strict=True):
        files.write_image(path.parent / name, image)
    write_poses(path, names, camera, posed.camera_to_world, extra)
    return path


def render_views(
    scene, camera, camera_to_world, spp, seed, integrator=None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render a scene from n poses: rgb, alpha and depth, one row a view."""
    views = iterate_views(scene, camera, camera_to_world, spp, seed, integrator)
    rgb, alpha, depth = zip(*((v.rgb, v.alpha, v.depth) for v in views), strict=True)
    return np.stack(rgb), np.stack(alpha), np.stack(depth)


CAMERA = from_fov(240, 180, 60.0)


def noise(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey noise with detail at several scales, in [0, 1]."""
    total = np.zeros_like(x)
    for level in range(1, 6):
        table = rng.random((64, 64))
        u, v = x * 1.3 * 2**level, y * 1.3 * 2**level
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = u - i, v - j
        for di, dj in np.ndindex(2, 2):
            weight = np.abs(1 - di - a) * np.abs(1 - dj - b)
            total += weight * table[(i + di) % 64, (j + dj) % 64] / 2**level
    return np.clip((total - 0.2) / 0.6, 0, 1)


def corner_photograph(pose: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Trace a floor z = 0, walls x = 3, y = 3 and what is behind, from inside."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    local = x, y, np.ones_like(u)
    if camera.is_fisheye:
        local = direction(x, y, *camera.distortion[:4])
    ray = np.stack(local, -1) @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore"):
        near, far = ((np.array(w) - eye) / ray for w in ([3.0, 3, 0], [-6.0, -6, 5]))
    t = np.concatenate([near, far], -1)
    t = np.where(t > 1e-9, t, np.inf)
    face = t.argmin(-1)
    point = eye + t.min(-1)[..., None] * ray
    rng = np.random.default_rng(5)
    grey = np.zeros(u.shape)
    for side in range(6):
        a, b = np.delete(np.arange(3), side % 3)
        grey += (face == side) * noise(rng, point[..., a], point[..., b])
    return np.repeat(np.round(255 * grey).astype(np.uint8)[..., None], 3, axis=2)


def corner_poses(count: int = 8) -> np.ndarray:
    angle = np.linspace(-0.5, 0.5, count)
    x, y = 2 - 4 * np.cos(angle + 0.785), 2 - 4 * np.sin(angle + 0.785)
    eyes = np.stack([x, y, 1.6 + angle], 1)
    return np.stack([look_at(eye, np.array([2.2, 2.2, 1.2])) for eye in eyes])


def aligned(points: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a similarity of points (n, 3); return it applied, and its rotation."""
    centre, target = points.mean(0), targets.mean(0)
    u, s, vt = np.linalg.svd((targets - target).T @ (points - centre))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / ((points - centre) ** 2).sum()
    return scale * (points - centre) @ turn.T + target, turn


HALF, HEIGHT = 25.0, 12.0  # metres
ROOM = np.array([-34.0, -34.0, -2.0]), np.array([34.0, 34.0, 14.0])
_OFFSET = 14.0  # of the cameras, so that walls are up to 50 m away
_SKY = 150  # sRGB


def room_views(
    count: int, turn: float = 0.0, seed: int = 0, size: tuple[int, int] = (96, 48)
) -> tuple[PosedImages, np.ndarray]:
    """Ray trace four walls, turned by radians, and a floor; return depths too."""
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
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    o, d = rotation @ eye, ray @ rotation.T
    with np.errstate(divide="ignore"):
        wall = ((np.sign(d) * HALF - o) / d)[..., :2].min(-1)
        floor = np.where(d[..., 2] < 0, -o[2] / d[..., 2], np.inf)
    wall = np.where(o[2] + wall * d[..., 2] < HEIGHT, wall, np.inf)
    return np.minimum(wall, floor)


def shell_cells(shape: tuple[int, int, int], layers: int) -> np.ndarray:
    """Mark the cells over `ROOM` of walls (unturned) and floor, in layers outwards."""
    cells = np.zeros(shape, bool)
    scale = np.array(shape) / (ROOM[1] - ROOM[0])
    faces = np.array([[-HALF, -HALF, 0.0], [HALF, HALF, HEIGHT]])
    low, high = np.floor((faces - ROOM[0]) * scale).astype(int)
    outer = layers - 1
    x, y, z = (slice(a - outer, b + outer + 1) for a, b in zip(low, high, strict=True))
    cells[x, y, z.start : high[2] + 1] = True
    cells[low[0] + 1 : high[0], low[1] + 1 : high[1], low[2] + 1 :] = False
    return cells


class SolidField(AbstractField):
    """Opaque and grey in the cells of its occupancy."""

    kind = "solid"

    def __init__(self, step_m: float, cone: float) -> None:
        self.lower, self.upper = ROOM
        self.step_m, self.cone = step_m, cone
        self.occupy(Occupancy.full())

    def eval_everywhere(
        self, point: Any, direction: Any, active: Any
    ) -> tuple[Any, Any]:
        return mi.Float(1e4) & active, mi.Color3f(0.2) & active
