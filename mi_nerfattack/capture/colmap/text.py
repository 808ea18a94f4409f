"""COLMAP's text files: `cameras.txt`, `images.txt`, `points3D.txt`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from mi_nerfattack.capture.colmap.records import CameraRecord, ImageRecord
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

_CAMERA = "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
_IMAGE = "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
_POINT = "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"
_Number = TypeVar("_Number", int, float)


def read_cameras(path: Path) -> list[CameraRecord]:
    """Read `cameras.txt`.

    Raises:
        InputError: naming file and line.
    """
    result = []
    for number, line in _lines(path):
        words = line.split()
        _check_length(path, number, words, 5, _CAMERA)
        camera_id, width, height = _numbers(path, number, (words[0], *words[2:4]), int)
        parameters = _numbers(path, number, words[4:], float)
        result.append(CameraRecord(camera_id, words[1], width, height, parameters))
    return result


def read_images(path: Path) -> list[ImageRecord]:
    """Read `images.txt`, two lines an image; the second, its features, is skipped.

    Raises:
        InputError: naming file and line.
    """
    result = []
    lines = _lines(path, skip_after_each=True)
    for number, line in lines:
        words = line.split(maxsplit=9)
        _check_length(path, number, words, 10, _IMAGE)
        pose = _numbers(path, number, words[1:8], float)
        (camera_id,) = _numbers(path, number, words[8:9], int)
        result.append(ImageRecord(words[9].strip(), pose[:4], pose[4:], camera_id))
    return result


def read_points(path: Path) -> np.ndarray:
    """Read the positions (n, 3) of `points3D.txt`.

    Raises:
        InputError: naming file and line.
    """
    result = []
    for number, line in _lines(path):
        words = line.split(maxsplit=8)
        _check_length(path, number, words, 8, _POINT)
        result.append(_numbers(path, number, words[1:4], float))
    return np.array(result, np.float64).reshape(-1, 3)


def _lines(path: Path, skip_after_each: bool = False) -> Iterator[tuple[int, str]]:
    """Yield number and text of the lines that are neither empty nor a comment."""
    lines = iter(enumerate(files.read_text(path).splitlines(), start=1))
    for number, line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line
            if skip_after_each:
                next(lines, None)


def _check_length(
    path: Path, number: int, words: Sequence[str], least: int, fields: str
) -> None:
    if len(words) < least:
        raise InputError(
            f"{path}: line {number}: {len(words)} fields; needs {fields}; the file is "
            "truncated or of another kind"
        )


def _numbers(
    path: Path, number: int, words: Sequence[str], kind: type[_Number]
) -> tuple[_Number, ...]:
    try:
        values = tuple(kind(word) for word in words)
    except ValueError as error:
        noun = "whole numbers" if kind is int else "numbers"
        raise InputError(
            f"{path}: line {number}: {' '.join(words)!r}; must be {noun}"
        ) from error
    if not np.isfinite(values).all():
        raise InputError(f"{path}: line {number}: {' '.join(words)!r}; must be finite")
    return values
