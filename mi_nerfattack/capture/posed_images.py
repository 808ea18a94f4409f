"""Images from known poses, in memory.

Poses are OpenCV camera-to-world matrices.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mi_nerfattack.backend.colour import (
    linear_to_uint8,
    srgb_to_linear_numpy,
    straight_rgba,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.pose import check_rigid

_HELD_OUT_EVERY = 8


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Images from known poses.

    Args:
        images: n images (height, width, 3 or 4), uint8 sRGB, as `stacked` puts them
            together; alpha is not premultiplied, and all have it or none.
        camera_to_world: (n, 4, 4), OpenCV axes, float64.
        camera: intrinsics shared by all images, in pixels of `images`; where
            `cameras` is given, those of the first.
        names: n names for messages and reports.
        missing: names of frames that were left out because they have no image.
        cameras: n intrinsics, where they differ between the images; else empty.
        points: (m, 3), float64, metres: points that the images show, sparse and with
            outliers, as structure from motion leaves them; None if unknown.
        unit: what one unit of the poses is, as its source says: "metre",
            "arbitrary", "unknown" or another word.
        masks: n masks (height, width), bool, as `stacked` puts them together: whether a
            pixel counts; None where all do.

    Raises:
        InputError: the shapes contradict each other or a pose is not rigid.
    """

    images: np.ndarray
    camera_to_world: np.ndarray
    camera: Camera
    names: tuple[str, ...]
    missing: tuple[str, ...] = ()
    cameras: tuple[Camera, ...] = ()
    points: np.ndarray | None = None
    unit: str = "metre"
    masks: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.images)
        if not n:
            raise InputError("images: none; give at least one")
        if self.camera_to_world.shape != (n, 4, 4) or len(self.names) != n:
            raise InputError(
                f"camera_to_world, names: shape {self.camera_to_world.shape} and "
                f"{len(self.names)} names; must match {n} images"
            )
        for name, matrix in zip(self.names, self.camera_to_world, strict=True):
            check_rigid(matrix, name)
        if self.cameras and len(self.cameras) != n:
            raise InputError(
                f"cameras: {len(self.cameras)}; must be one for each of {n} images, "
                "or none where all share `camera`"
            )
        for index in range(n):
            self._check_image(index)
        shapes = [image.shape[:2] for image in self.images]
        if self.masks is not None and [m.shape for m in self.masks] != shapes:
            raise InputError("masks: must have the sizes of the images, one for each")

    def _check_image(self, index: int) -> None:
        image, camera = self.images[index], self.camera_of(index)
        if image.dtype != np.uint8:
            raise InputError(f"images: {image.dtype}; must be uint8 sRGB")
        channels = image.shape[2:]
        if channels not in ((3,), (4,)) or channels != self.images[0].shape[2:]:
            raise InputError(
                f"images: {self.names[index]} has shape {image.shape}; must be "
                "(height, width, 3) in all, or (height, width, 4) in all"
            )
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{self.names[index]}: its camera has {camera.width} x "
                f"{camera.height} px, the image {image.shape[1]} x {image.shape[0]} px"
            )

    @property
    def channels(self) -> int:
        """3, or 4 with alpha."""
        return self.images[0].shape[2]

    @property
    def has_one_size(self) -> bool:
        """Whether all images have the size of `camera`."""
        return self.images.dtype != object

    def camera_of(self, index: int) -> Camera:
        """Return the intrinsics of one image, in its pixels."""
        return self.cameras[index] if self.cameras else self.camera

    def __len__(self) -> int:
        return len(self.images)


def held_out(n: int) -> np.ndarray:
    """Return the indices, every 8th from 0, that are never fitted to."""
    return np.arange(0, n, _HELD_OUT_EVERY)


def stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Put arrays together: one (n, ...), or where shapes differ n in one of objects."""
    if len({array.shape for array in arrays}) == 1:
        return np.stack(arrays)
    result = np.empty(len(arrays), object)
    result[:] = arrays
    return result


def load_images(
    paths: Sequence[Path],
    cameras: Sequence[Camera],
    source: Path,
    long_edge_px: int | None,
) -> tuple[np.ndarray, tuple[Camera, ...]]:
    """Read images, and reduce them by averaging areas in linear light.

    Args:
        paths: of the images.
        cameras: one per image, in pixels of the files.
        source: the file that they come from, for messages.
        long_edge_px: longer edge of the result, pixels; images are never enlarged,
            and None keeps them.

    Returns:
        n images (height, width, 3 or 4), uint8 sRGB, as `stacked` puts them together,
        and one camera per image in their pixels. Alpha that is 255 everywhere is left
        out.

    Raises:
        InputError: an image cannot be read, or its size is not that of its camera.
    """
    if long_edge_px is not None and long_edge_px < 1:
        raise InputError(f"long_edge_px: {long_edge_px}; must be at least 1")
    result: list[np.ndarray] = []
    for path, camera in zip(paths, cameras, strict=True):
        image = files.read_image(path)
        height, width = image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{path}: {width} x {height} px, but the intrinsics (w, h) in {source} "
                f"are for {camera.width} x {camera.height} px; give the images that "
                "were calibrated, or scale the intrinsics"
            )
        target = _reduced(camera, long_edge_px)
        result.append(resize_area(image, target.width, target.height))
    if all(image.shape[2] == 3 or (image[..., 3] == 255).all() for image in result):
        result = [image[..., :3] for image in result]
    elif len({image.shape[2] for image in result}) > 1:
        result = [_with_alpha(image) for image in result]
    return stacked(result), tuple(_reduced(c, long_edge_px) for c in cameras)


def differing(cameras: Iterable[Camera]) -> tuple[Camera, ...]:
    """Return the cameras, or nothing if they are all equal."""
    lenses = tuple(cameras)
    return lenses if len(set(lenses)) > 1 else ()


def _reduced(camera: Camera, long_edge_px: int | None) -> Camera:
    edge = max(camera.width, camera.height)
    if long_edge_px is None or long_edge_px >= edge:
        return camera
    scale = long_edge_px / edge
    width, height = (max(1, round(scale * v)) for v in (camera.width, camera.height))
    return camera.resized(width, height)


def _with_alpha(image: np.ndarray) -> np.ndarray:
    if image.shape[2] == 4:
        return image
    return np.concatenate([image, np.full_like(image[..., :1], 255)], axis=2)


def resize_area(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Reduce an image by averaging areas in linear light, weighted by alpha.

    Args:
        image: (h, w, 3 or 4), uint8 sRGB, alpha not premultiplied.
        width: new width in pixels.
        height: new height in pixels.
    """
    if image.shape[:2] == (height, width):
        return image
    table = srgb_to_linear_numpy(np.arange(256, dtype=np.float32) / 255)
    linear = table[image[..., :3]]
    if image.shape[2] == 3:
        return linear_to_uint8(_box_filter(linear, width, height))
    alpha = image[..., 3:].astype(np.float32) / 255
    weight = _box_filter(alpha, width, height)
    colour = _box_filter(linear * alpha, width, height)
    return straight_rgba(colour, weight)


def _box_filter(image: np.ndarray, width: int, height: int) -> np.ndarray:
    planes = [
        Image.fromarray(np.ascontiguousarray(plane)).resize(
            (width, height), Image.Resampling.BOX
        )
        for plane in np.moveaxis(image, 2, 0)
    ]
    return np.stack([np.asarray(plane) for plane in planes], axis=2)
