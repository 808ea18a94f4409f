"""Posed images, and their `transforms.json` folders (nerfstudio, Instant-NGP, Blender).

In memory poses are OpenCV camera-to-world matrices; in the file they are OpenGL.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mi_nerfattack import files
from mi_nerfattack.capture.intrinsics import read_camera
from mi_nerfattack.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import Camera
from mi_nerfattack.render.conventions import opencv_to_opengl, opengl_to_opencv

_FILE_NAMES = ("transforms.json", "transforms_train.json")
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".webp")
_HELD_OUT_EVERY = 8


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Images of one size from known poses.

    Args:
        images: (n, height, width, 3 or 4), uint8 sRGB; alpha is not premultiplied.
        camera_to_world: (n, 4, 4), OpenCV axes, float64.
        camera: intrinsics shared by all images, in pixels of `images`; where
            `cameras` is given, those of the first.
        names: n names for messages and reports.
        missing: names of frames that were left out because they have no image.
        cameras: n intrinsics, where they differ between the images; else empty.

    Raises:
        InputError: the shapes contradict each other or a pose is not rigid.
    """

    images: np.ndarray
    camera_to_world: np.ndarray
    camera: Camera
    names: tuple[str, ...]
    missing: tuple[str, ...] = ()
    cameras: tuple[Camera, ...] = ()

    def __post_init__(self) -> None:
        """Check shapes and poses."""
        n, size = len(self.images), (self.camera.height, self.camera.width)
        shape = self.images.shape
        if self.images.ndim != 4 or shape[1:3] != size or shape[3] not in (3, 4):
            raise InputError(
                f"images: shape {shape}; must be (n, {size[0]}, {size[1]}, 3 or 4)"
            )
        if self.images.dtype != np.uint8:
            raise InputError(f"images: {self.images.dtype}; must be uint8 sRGB")
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
        for name, camera in zip(self.names, self.cameras, strict=False):
            if (camera.height, camera.width) != size:
                raise InputError(
                    f"{name}: its camera has {camera.width} x {camera.height} px, the "
                    f"images have {size[1]} x {size[0]} px; all must have one size"
                )

    def camera_of(self, index: int) -> Camera:
        """Return the intrinsics of one image, in its pixels."""
        return self.cameras[index] if self.cameras else self.camera

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.images)


def held_out(n: int) -> np.ndarray:
    """Return the indices, every 8th from 0, that are never fitted to."""
    return np.arange(0, n, _HELD_OUT_EVERY)


def check_rigid(matrix: np.ndarray, where: str) -> None:
    """Check that a (4, 4) matrix is a rotation and a translation.

    Raises:
        InputError: with `where`, if it scales, shears, reflects or is not finite.
    """
    if not np.all(np.isfinite(matrix)):
        raise InputError(f"{where}: the matrix contains NaN or infinity")
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{where}: last row {matrix[3].tolist()}; must be 0 0 0 1")
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > 1e-3:
        lengths = np.linalg.norm(rotation, axis=0).round(6).tolist()
        raise InputError(
            f"{where}: not a rigid pose, the columns have lengths {lengths}; they "
            "must be orthonormal, without scale or shear"
        )
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: the pose is a reflection (determinant -1); "
            "the camera axes must be right-handed"
        )


def read_transforms(
    path: str | Path, long_edge_px: int | None = None, skip_missing: bool = False
) -> PosedImages:
    """Read a folder of posed images.

    Reads `fl_x, fl_y, cx, cy, w, h, camera_angle_x, camera_angle_y, k1, k2, p1, p2`
    at the top level or, if equal in all frames, in the frames. Images are reduced by
    averaging areas in linear light; they are never enlarged.

    Args:
        path: JSON file, or the folder of `transforms.json` (or, for Blender's
            synthetic scenes, `transforms_train.json`).
        long_edge_px: reduce images to this longer edge, in pixels; None keeps them.
        skip_missing: leave out frames without an image file, as some published data
            sets need, and list them in `PosedImages.missing`.

    Raises:
        InputError: naming the file and the field that cannot be used.
    """
    source = find_transforms(Path(path))
    table = files.read_json(source)
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{source}: frames: missing or empty; needs a list of frames")
    if long_edge_px is not None and long_edge_px < 1:
        raise InputError(f"long_edge_px: {long_edge_px}; must be at least 1")
    found: list[tuple[int, Path]] = []
    missing: list[str] = []
    for i, frame in enumerate(frames):
        image = _find_image(source, i, frame)
        if image is None:
            missing.append(frame["file_path"])
        else:
            found.append((i, image))
    if missing and (not skip_missing or not found):
        raise InputError(
            f"{source}: {len(missing)} of {len(frames)} frames have no image, first "
            f"{missing[0]!r}; restore the files or leave these frames out "
            "(skip_missing)"
        )
    poses = np.stack([read_pose(source, i, frames[i]) for i, _ in found])
    first = files.read_image(found[0][1])
    camera = read_camera(source, table, [frames[i] for i, _ in found], first.shape)
    target = _reduced(camera, long_edge_px)
    images = _read_images([image for _, image in found], camera, target)
    names = tuple(str(frames[i]["file_path"]) for i, _ in found)
    return PosedImages(images, poses, target, names, tuple(missing))


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
    root = files.make_folder(folder)
    files.make_folder(root / "images")
    for name, image in zip(names, posed.images, strict=True):
        files.write_image(root / name, image)
    path = root / "transforms.json"
    write_poses(path, names, camera, posed.camera_to_world, extra)
    return path


def write_poses(
    path: Path,
    names: Sequence[str],
    camera: Camera,
    camera_to_world: np.ndarray,
    extra: Mapping[str, Any] | None = None,
) -> None:
    """Write a `transforms.json` for images that exist; see `write_transforms`."""
    table: dict[str, Any] = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "k1": camera.k1,
        "k2": camera.k2,
        "p1": camera.p1,
        "p2": camera.p2,
        "camera_angle_x": 2 * math.atan(0.5 * camera.width / camera.fx),
        **(extra or {}),
    }
    table["frames"] = [
        {"file_path": name, "transform_matrix": matrix.tolist()}
        for name, matrix in zip(names, opencv_to_opengl(camera_to_world), strict=True)
    ]
    files.write_json(path, table)


def find_transforms(path: Path) -> Path:
    """Return the JSON file that a path names: itself, or the one in the folder."""
    if not path.is_dir():
        return path
    for name in _FILE_NAMES:
        if (path / name).is_file():
            return path / name
    raise InputError(f"{path}: has neither {_FILE_NAMES[0]} nor {_FILE_NAMES[1]}")


def _find_image(source: Path, index: int, frame: Any) -> Path | None:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str) or not name:
        raise InputError(f"{source}: frames[{index}].file_path: {name!r}; needs a path")
    base = source.parent / name.replace("\\", "/")
    for suffix in _SUFFIXES:
        candidate = base.with_name(base.name + suffix)
        if candidate.is_file():
            return candidate
    return None


def read_pose(source: Path, index: int, frame: Mapping[str, Any]) -> np.ndarray:
    """Read the pose of one frame.

    Args:
        source: the JSON file, for messages.
        index: of the frame, for messages.
        frame: with `transform_matrix`, OpenGL axes, (4, 4) or (3, 4).

    Returns:
        camera_to_world: (4, 4), OpenCV axes, float64.

    Raises:
        InputError: the matrix is missing or not a rigid pose.
    """
    where = f"{source}: frames[{index}].transform_matrix"
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: not a matrix of numbers; needs 4 x 4") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: shape {matrix.shape}; needs 4 x 4 numbers")
    check_rigid(matrix, where)
    return opengl_to_opencv(matrix)


def _reduced(camera: Camera, long_edge_px: int | None) -> Camera:
    edge = max(camera.width, camera.height)
    if long_edge_px is None or long_edge_px >= edge:
        return camera
    scale = long_edge_px / edge
    width, height = (max(1, round(scale * v)) for v in (camera.width, camera.height))
    return camera.resized(width, height)


def _read_images(paths: list[Path], camera: Camera, target: Camera) -> np.ndarray:
    result = []
    for path in paths:
        image = files.read_image(path)
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{path}: {image.shape[1]} x {image.shape[0]} px; the intrinsics and "
                f"the other images have {camera.width} x {camera.height} px (w, h)"
            )
        result.append(resize_area(image, target.width, target.height))
    if len({image.shape[2] for image in result}) > 1:
        result = [_with_alpha(image) for image in result]
    return np.stack(result)


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
    colour = np.divide(colour, weight, out=np.zeros_like(colour), where=weight > 0)
    opacity = np.round(255 * weight).astype(np.uint8)
    return np.concatenate([linear_to_uint8(colour), opacity], axis=2)


def _box_filter(image: np.ndarray, width: int, height: int) -> np.ndarray:
    planes = [
        Image.fromarray(np.ascontiguousarray(plane)).resize(
            (width, height), Image.Resampling.BOX
        )
        for plane in np.moveaxis(image, 2, 0)
    ]
    return np.stack([np.asarray(plane) for plane in planes], axis=2)
