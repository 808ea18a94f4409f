"""Analytic pictures of a coloured sphere, for tests of fitting."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers.posed_folders import write_transforms

from mi_nerfattack.capture.posed_images import PosedImages, stacked
from mi_nerfattack.fields import GridLayout, NGPLayout
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at

SIZE = 24
RADIUS = 0.4
BOX = np.full(3, -0.5), np.full(3, 0.5)
#: One of each kind for all fits: their kernels take seconds to compile.
TINY_GRID, TINY_NGP = GridLayout(4, 4, 16), NGPLayout(4, 2, 10, 4, 32, 16)


def directions(count: int) -> np.ndarray:
    """Unit vectors (count, 3) all over the sphere."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    phi = 2.4 * np.arange(count)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def sphere_colour(normal: np.ndarray) -> np.ndarray:
    """Return sRGB that varies smoothly over a sphere."""
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
    whole, depth = sphere_views(count, alpha)
    crops = [np.s_[:, :], np.s_[:, 4:-4], np.s_[3:, :], np.s_[:, 4:-4]] * count
    cut = [a[crop] for a, crop in zip(whole.images, crops, strict=False)]
    maps = [a[crop] for a, crop in zip(depth, crops, strict=False)]
    cameras = [
        replace(
            whole.camera,
            height=own.shape[0],
            width=own.shape[1],
            cx=whole.camera.cx - (columns.start or 0),
            cy=whole.camera.cy - (rows.start or 0),
        )
        for own, (rows, columns) in zip(cut, crops, strict=False)
    ]
    mixed = replace(whole, images=stacked(cut), cameras=tuple(cameras))
    return mixed, stacked(maps)


def world_rays(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Unit directions (height, width, 3) of a camera, in NumPy."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1
    )
    world = local @ pose[:3, :3].T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def write_folder(root: Path, depth: np.ndarray | None) -> PosedImages:
    """Write sphere views as a folder, with a depth file unless None."""
    images, _ = sphere_views(4)
    extra = None if depth is None else {"depth_file": "depth.safetensors"}
    write_transforms(root, images.images, images.camera, images.camera_to_world, extra)
    if depth is not None:
        files.write_safetensors(root / "depth.safetensors", {"depth": depth}, {})
    return images
