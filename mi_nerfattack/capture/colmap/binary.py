"""COLMAP's binary files: `cameras.bin`, `images.bin`, `points3D.bin`.

All numbers are little-endian; each file starts with the number of its records.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.colmap.records import CameraRecord, ImageRecord
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.conventions import COLMAP_MODELS

MAX_BYTES = 1 << 31

# COLMAP's numbers of the models; only those in COLMAP_MODELS have known parameters
_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
)
_MAX_NAME_BYTES = 4096
_FEATURE_BYTES = 24  # x, y, point3D_id
_TRACK_BYTES = 8  # image_id, point2D_idx


class _Cursor:
    """Reads a file's records one after another, never beyond its end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._raw = files.read_bytes(path, MAX_BYTES)
        self._at = 0

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        """Return the values of a `struct` layout, little-endian without padding."""
        start = self._at
        self.skip(struct.calcsize("<" + layout), what)
        return struct.unpack_from("<" + layout, self._raw, start)

    def skip(self, size: int, what: str) -> None:
        """Pass over `size` bytes."""
        rest = len(self._raw) - self._at
        if size > rest:
            raise InputError(
                f"{self._path}: byte {self._at}: {what} takes {size} bytes, {rest} are "
                "left; the file is truncated or not of COLMAP, copy it again"
            )
        self._at += size

    def count(self, least: int, what: str) -> int:
        """Return a number of items of at least `least` bytes that fit in the rest."""
        start = self._at
        (value,) = self.take("Q", f"the number of {what}")
        rest = len(self._raw) - self._at
        if value * least > rest:
            raise InputError(
                f"{self._path}: byte {start}: {value} {what} need {value * least} "
                f"bytes, {rest} are left; the file is truncated or not of COLMAP, copy "
                "it again"
            )
        return value

    def name(self) -> str:
        """Return a UTF-8 text that ends in a zero byte."""
        end = self._raw.find(b"\0", self._at, self._at + _MAX_NAME_BYTES)
        raw = self._raw[self._at : max(end, self._at)]
        try:
            name = raw.decode("utf-8")
        except UnicodeDecodeError:
            name = ""
        if not name.isprintable() or not name:
            raise InputError(
                f"{self._path}: byte {self._at}: no image name ({raw[:16]!r}); the "
                "file is damaged or not of COLMAP, copy it again"
            )
        self._at = end + 1
        return name

    def finish(self) -> None:
        """Check that nothing is left."""
        if self._at < len(self._raw):
            raise InputError(
                f"{self._path}: {len(self._raw) - self._at} bytes after the last "
                f"record, from byte {self._at}; the file is damaged or not of COLMAP, "
                "copy it again"
            )


def read_cameras(path: Path) -> list[CameraRecord]:
    """Read `cameras.bin`.

    Raises:
        InputError: the file is damaged, or a model is not one of `COLMAP_MODELS`, the
            length of whose parameters is known.
    """
    cursor = _Cursor(path)
    result = []
    for _ in range(cursor.count(24, "cameras")):
        camera_id, model_id, width, height = cursor.take("iiQQ", "a camera")
        if not 0 <= model_id < len(_MODELS):
            raise InputError(
                f"{path}: camera {camera_id}: model number {model_id} is unknown; the "
                "file is damaged or not of COLMAP, copy it again"
            )
        model = _MODELS[model_id]
        length = len(COLMAP_MODELS.get(model, ()))
        parameters = cursor.take(f"{length}d", f"camera {camera_id}")
        result.append(CameraRecord(camera_id, model, width, height, parameters))
        if not length:
            return result  # what follows cannot be told apart; the caller refuses it
    cursor.finish()
    return result


def read_images(path: Path) -> list[ImageRecord]:
    """Read `images.bin`; the features are skipped.

    Raises:
        InputError: the file is damaged.
    """
    cursor = _Cursor(path)
    result = []
    for _ in range(cursor.count(73, "images")):
        _, *pose, camera_id = cursor.take("I7dI", "an image")
        name = cursor.name()
        features = cursor.count(_FEATURE_BYTES, f"features of {name!r}")
        cursor.skip(features * _FEATURE_BYTES, f"features of {name!r}")
        quaternion, translation = tuple(pose[:4]), tuple(pose[4:])
        result.append(ImageRecord(name, quaternion, translation, camera_id))
    cursor.finish()
    return result


def read_points(path: Path) -> np.ndarray:
    """Read the positions (n, 3) of `points3D.bin`.

    Raises:
        InputError: the file is damaged, or a position is not finite.
    """
    cursor = _Cursor(path)
    result = np.empty((cursor.count(51, "points"), 3))
    for i in range(len(result)):
        _, *result[i] = cursor.take("Q3d", "a point")
        cursor.skip(11, "a point")
        length = cursor.count(_TRACK_BYTES, "entries of a track")
        cursor.skip(length * _TRACK_BYTES, "a track")
    cursor.finish()
    if not np.isfinite(result).all():
        raise InputError(f"{path}: a position is not finite; copy the file again")
    return result
