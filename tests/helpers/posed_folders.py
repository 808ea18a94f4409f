"""Posed images as files, and views of a scene as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.transforms import begin_posed, write_poses
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.pathtrace.views import iterate_views


def write_transforms(
    folder: str | Path,
    images: np.ndarray,
    camera: Camera,
    camera_to_world: np.ndarray,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write images as PNG and their poses as `transforms.json`.

    Args:
        folder: made if needed.
        images: (n, height, width, 3 or 4), uint8 sRGB.
        camera: shared intrinsics.
        camera_to_world: (n, 4, 4), OpenCV axes.
        extra: more keys for the top level.

    Returns:
        Path of the JSON file, which is written last.
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
    views = list(iterate_views(scene, camera, camera_to_world, spp, seed, integrator))
    return (
        np.stack([view.rgb for view in views]),
        np.stack([view.alpha for view in views]),
        np.stack([view.depth for view in views]),
    )
