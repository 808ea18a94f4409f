"""Which pixels of images count: grey pictures, black where an image is ignored.

COLMAP finds the mask of a photograph by its name, ``NAME.jpg.png``; a `transforms.json`
names it in each frame's `mask_path`, as nerfstudio does.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from mi_nerfattack.capture.posed_images import stacked
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera

SUFFIX = ".png"
_LEAST_SHARE = 0.999  # share of a reduced pixel that has to count


def read_mask(path: Path, width: int, height: int) -> np.ndarray:
    """Read the mask of an image.

    Args:
        path: of the mask.
        width: of the image, pixels.
        height: of the image, pixels.

    Returns:
        (height, width), bool, whether a pixel counts.

    Raises:
        InputError: it cannot be read, has another size, or leaves nothing.
    """
    image = files.read_image(path)
    if image.shape[:2] != (height, width):
        raise InputError(
            f"{path}: {image.shape[1]} x {image.shape[0]} px; the mask of an upright "
            f"image of {width} x {height} px must be as large"
        )
    mask = np.any(image[..., :3] > 0, axis=2)
    if not mask.any():
        raise InputError(
            f"{path}: black everywhere, so that nothing of the image counts; white is "
            "what counts, black what is ignored"
        )
    return mask


def load_masks(
    paths: Sequence[Path | None], cameras: Sequence[Camera], reduced: Sequence[Camera]
) -> np.ndarray | None:
    """Read masks, and reduce them: a pixel counts if all that it is made of does.

    Args:
        paths: of the masks; None where all of an image counts.
        cameras: one per image, in pixels of the files.
        reduced: one per image, in pixels of the result.

    Returns:
        n masks (height, width), bool, as `stacked` puts them together; None where no
        image has one.

    Raises:
        InputError: see `read_mask`; or a reduced mask leaves nothing.
    """
    if not any(paths):
        return None
    result = []
    for path, camera, small in zip(paths, cameras, reduced, strict=True):
        mask = np.ones((small.height, small.width), bool)
        if path is not None:
            full = read_mask(path, camera.width, camera.height).astype(np.float32)
            size = small.width, small.height
            shares = Image.fromarray(full).resize(size, Image.Resampling.BOX)
            mask = np.asarray(shares) > _LEAST_SHARE
        if not mask.any():
            raise InputError(
                f"{path}: no pixel of {small.width} x {small.height} px is white as a "
                "whole; reduce the images less (--long-edge)"
            )
        result.append(mask)
    return stacked(result)


def stage_masks(
    masks: Path, photographs: Path, names: Sequence[str], target: Path
) -> None:
    """Copy masks to where COLMAP looks for them, white where a photograph has none.

    Args:
        masks: folder of ``NAME.png`` for photographs that have one; or one picture for
            all.
        photographs: folder of these, upright.
        names: in it.
        target: folder of the copies.

    Raises:
        InputError: a mask is not as large as its photograph or leaves nothing of it, or
            the folder has none, or one that belongs to no photograph.
    """
    with files.reported(masks):
        masks.stat()
        is_folder = masks.is_dir()
        inside = list(masks.iterdir()) if is_folder else []
    paths = {name: masks for name in names}
    if is_folder:
        file_names = {p.name for p in inside if p.suffix.lower() == SUFFIX}
        paths = {n: masks / (n + SUFFIX) for n in names if n + SUFFIX in file_names}
        strays = sorted(file_names - {path.name for path in paths.values()})
        if strays or not paths:
            problem = (
                f"{strays[0]} belongs to no photograph" if strays else "has no mask"
            )
            raise InputError(
                f"{masks}: {problem}; masks are PNGs with the whole name of their "
                f"photograph before .png: {names[0]}{SUFFIX}"
            )
    for name in names:  # without a mask, COLMAP leaves the photograph out
        height, width = files.read_image(photographs / name).shape[:2]
        grey = np.full((height, width), 255, np.uint8)
        if name in paths:
            grey[~read_mask(paths[name], width, height)] = 0
        files.write_image(target / (name + SUFFIX), grey)
