"""The left eye of a ZED as a UVC camera, which needs no SDK.

The device gives both eyes side by side, the left one left, as its lenses show them. The
calibration is the file of its serial number, `SN<serial>.conf`, from
``http://calib.stereolabs.com/?SN=<serial>`` or ``/usr/local/zed/settings/``.

Source: stereolabs/zed-open-capture, videocapture_def.hpp.
"""

from __future__ import annotations

import configparser
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.robot.camera.preparation import AbstractPreparation
from mi_nerfattack.system.extras import load_extra

#: Width and height of an eye, pixels, and the end of a section's name, by mode.
MODES = {
    "HD2K": (2208, 1242, "2K"),
    "HD1080": (1920, 1080, "FHD"),
    "HD720": (1280, 720, "HD"),
    "VGA": (672, 376, "VGA"),
}
_MAX_BYTES = 1 << 20
_PINHOLE, _DISTORTION = ("fx", "fy", "cx", "cy"), ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class EyeCalibration:
    """What the file says of an eye in a mode.

    Args:
        where: file and section, for messages.
        pinhole: intrinsics without distortion.
        distortion: k1, k2, p1, p2, k3 as in `cv2.projectPoints`.
    """

    where: str
    pinhole: Camera
    distortion: tuple[float, ...]


def read_left_eye(path: Path, mode: str = "VGA") -> EyeCalibration:
    """Read the left eye's calibration.

    Args:
        path: `SN<serial>.conf`.
        mode: one of `MODES`.

    Raises:
        InputError: another mode, or a file that has no or impossible numbers for it.
    """
    if mode not in MODES:
        raise InputError(f"ZED mode: {mode!r}; one of {', '.join(MODES)}")
    width, height, end = MODES[mode]
    section = f"LEFT_CAM_{end}"
    where = f"{path}: [{section}]"
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(files.read_bytes(path, _MAX_BYTES).decode("utf-8-sig"))
    except (configparser.Error, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: no calibration file of a ZED ({error}); download it again"
        ) from error
    if section not in parser:
        raise InputError(f"{where} is missing; download the file of the serial number")
    found = {name: _number(where, parser[section], name) for name in _PINHOLE}
    bent = tuple(_number(where, parser[section], name, "0") for name in _DISTORTION)
    fx, fy, cx, cy = found.values()
    try:
        # counted from the centre of the first pixel there, from its corner here
        pinhole = Camera(width, height, fx, fy, cx + 0.5, cy + 0.5)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    if not (0 < pinhole.cx < width and 0 < pinhole.cy < height):
        raise InputError(
            f"{where}: cx {cx:g}, cy {cy:g} lie outside {width} x {height} px"
        )
    return EyeCalibration(where, pinhole, bent)


def _number(
    where: str,
    section: configparser.SectionProxy,
    name: str,
    default: str | None = None,
) -> float:
    text = section.get(name, default)
    try:
        number = float(text) if text is not None else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{where}: {name}: {text!r}; must be a finite number")
    return number


class LeftEye(AbstractPreparation):
    """Makes frames of the left eye of those of both.

    Reduced by area means to the size asked for, then undistorted: straight lines are
    straight, with the focal lengths and the principal point that the eye has. Or left
    distorted, for scenes that are rendered and policies that are trained with the same
    distortion; `camera` says which it is.

    Args:
        eye: calibration in the mode that the device is in.
        size_px: width and height of the result; None for half, 336 x 188 of VGA. With
            another ratio, such as 366 x 188, the picture is stretched, and fx with it.
        is_undistorted: whether lens distortion is taken out.

    Raises:
        InputError: a size that is none, distortion that a scene's camera cannot have,
            or one that leaves parts of the image empty.
        SetupError: OpenCV is not installed.
    """

    def __init__(
        self,
        eye: EyeCalibration,
        size_px: tuple[int, int] | None = None,
        is_undistorted: bool = True,
    ) -> None:
        self._cv2 = load_extra("cv2", "markers", "a ZED")
        whole = eye.pinhole
        size = size_px or (whole.width // 2, whole.height // 2)
        if not (0 < size[0] <= whole.width and 0 < size[1] <= whole.height):
            raise InputError(
                f"ZED: {size[0]} x {size[1]} px; from 1 x 1 to {whole.width} x "
                f"{whole.height} px"
            )
        self.source_px = 2 * whole.width, whole.height
        self.camera = whole.resized(*size)
        self._maps = None
        if is_undistorted:
            self._maps = self._undistortion(eye)
        elif eye.distortion[4]:
            raise InputError(
                f"{eye.where}: k3 is {eye.distortion[4]:g}; rendered cameras have k1, "
                "k2, p1, p2 alone: take the distortion out"
            )
        else:
            self.camera = _distorted(eye, self.camera)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return the left eye's picture."""
        size = self.camera.width, self.camera.height
        left = np.ascontiguousarray(image[:, : image.shape[1] // 2])
        small = self._cv2.resize(left, size, interpolation=self._cv2.INTER_AREA)
        if self._maps is None:
            return small
        return self._cv2.remap(small, *self._maps, self._cv2.INTER_LINEAR)

    def _undistortion(self, eye: EyeCalibration) -> tuple[np.ndarray, np.ndarray]:
        """Return the column and the row (height, width) that each pixel is from."""
        camera = self.camera
        size = camera.width, camera.height
        matrix = np.array(
            [
                [camera.fx, 0, camera.cx - 0.5],
                [0, camera.fy, camera.cy - 0.5],
                [0, 0, 1],
            ]
        )
        columns, rows = self._cv2.initUndistortRectifyMap(
            matrix, np.array(eye.distortion), None, matrix, size, self._cv2.CV_32FC1
        )
        beyond = max(
            -columns.min(),
            -rows.min(),
            columns.max() - (size[0] - 1),
            rows.max() - (size[1] - 1),
        )
        if not beyond <= 1:
            raise InputError(
                f"{eye.where}: distortion {eye.distortion} leaves parts of the image "
                f"empty when taken out ({beyond:.1f} px); check the file, or keep it"
            )
        # up to a pixel beyond its edge is that edge
        return np.clip(columns, 0, size[0] - 1), np.clip(rows, 0, size[1] - 1)


def _distorted(eye: EyeCalibration, camera: Camera) -> Camera:
    names = dict(zip(_DISTORTION[:4], eye.distortion, strict=False))
    try:
        return replace(camera, **names)
    except InputError as error:
        raise InputError(f"{eye.where}: {error}") from error
