"""The left eye of a ZED as a UVC camera, which needs no SDK.

The device gives both eyes side by side, the left one left, as its lenses show them. The
calibration is the file of its serial number, `SN<serial>.conf`, from
``http://calib.stereolabs.com/?SN=<serial>`` or ``/usr/local/zed/settings/``. The lens'
parameters are in the section of eye and mode or, in newer files, of the eye alone.

Source: stereolabs/zed-open-capture, videocapture_def.hpp.
"""

from __future__ import annotations

import configparser
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mi_nerfattack.car.camera.preparation import AbstractPreparation
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, ray_slopes

#: Width and height of an eye, pixels, and the end of a section's name, by mode.
MODES = {
    "HD2K": (2208, 1242, "2K"),
    "HD1080": (1920, 1080, "FHD"),
    "HD1200": (1920, 1200, "FHD1200"),
    "HD720": (1280, 720, "HD"),
    "SVGA": (960, 600, "SVGA"),
    "VGA": (672, 376, "VGA"),
}
_MAX_BYTES = 1 << 20
_PINHOLE = ("fx", "fy", "cx", "cy")
_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
_LENS_SECTION = "LEFT_DISTO"


@dataclass(frozen=True)
class EyeCalibration:
    """What the file says of an eye in a mode.

    Args:
        where: file and section, for messages.
        pinhole: intrinsics without distortion.
        distortion: k1, k2, p1, p2, k3 and, of a rational lens, k4, k5, k6, as in
            `cv2.projectPoints`.
    """

    where: str
    pinhole: Camera
    distortion: tuple[float, ...]

    def camera(
        self, size_px: tuple[int, int] | None = None, is_undistorted: bool = True
    ) -> Camera:
        """Return a camera of the eye's own focal lengths and principal point.

        Args:
            size_px: width and height; None for half, 336 x 188 of VGA. With another
                ratio, such as 366 x 188, the picture is stretched, and fx with it.
            is_undistorted: whether it has none of the lens' distortion.

        Raises:
            InputError: a size that is none, or a distortion that no camera of a scene
                can have.
        """
        pinhole = self.pinhole
        width, height = size_px or (pinhole.width // 2, pinhole.height // 2)
        if not (0 < width <= pinhole.width and 0 < height <= pinhole.height):
            raise InputError(
                f"ZED: {width} x {height} px; from 1 x 1 to {pinhole.width} x "
                f"{pinhole.height} px"
            )
        camera = pinhole.resized(width, height)
        if is_undistorted:
            return camera
        lens = dict(zip(_LENS, self.distortion, strict=False))
        for name in _LENS[4:]:
            if value := lens.pop(name, 0.0):
                raise InputError(
                    f"{self.where}: {name} is {value:g}; rendered cameras have k1, k2, "
                    "p1, p2 alone: take the distortion out"
                )
        try:
            return replace(camera, **lens)
        except InputError as error:
            raise InputError(f"{self.where}: {error}") from error


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
    fx, fy, cx, cy = (_number(where, parser[section], name) for name in _PINHOLE)
    try:
        # counted from the centre of the first pixel there, from its corner here
        pinhole = Camera(width, height, fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    if not (0 < pinhole.cx < width and 0 < pinhole.cy < height):
        raise InputError(
            f"{where}: cx {cx:g}, cy {cy:g} lie outside {width} x {height} px"
        )
    return EyeCalibration(where, pinhole, _lens(path, parser, section))


def _lens(
    path: Path, parser: configparser.ConfigParser, section: str
) -> tuple[float, ...]:
    """Return the coefficients, of the eye's section in a mode or of the eye's own."""
    named = [n for n in (section, _LENS_SECTION) if n in parser]
    holders = [n for n in named if set(parser[n]) - set(_PINHOLE)]
    if len(holders) != 1:
        raise InputError(
            f"{path}: [{section}], [{_LENS_SECTION}]: {len(holders)} of them have a "
            "lens (k1, k2, ...); one must: download the file of the serial number"
        )
    (name,) = holders
    where, table = f"{path}: [{name}]", parser[name]
    if unknown := sorted(set(table) - {*_PINHOLE, *_LENS}):
        raise InputError(
            f"{where}: {', '.join(unknown)}: no coefficient that is read; it has "
            f"{', '.join((*_PINHOLE, *_LENS))}"
        )
    values = [_number(where, table, key, default="0") for key in _LENS]
    for key in ("k1", "k2"):  # which every lens has
        _number(where, table, key)
    return tuple(values if any(values[5:]) else values[:5])


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
    """Makes a camera's frames from the left half of the device's pictures.

    A frame looks like a scene that is rendered with `camera`: the intrinsics and the
    distortion of `camera` give each pixel its direction, and the pixel shows the eye's
    picture in this direction. The eye may have other intrinsics. Where `camera` has
    fewer pixels than the eye, the eye's picture is first reduced by area means.

    Args:
        eye: calibration in the mode that the device is in.
        camera: such as `eye.camera()`, or the one that a policy was trained with.

    Raises:
        InputError: the camera sees more than the eye.
        SetupError: OpenCV is not installed.
    """

    def __init__(self, eye: EyeCalibration, camera: Camera) -> None:
        self._cv2 = load_extra("cv2", "a ZED")
        pinhole = eye.pinhole
        self.source_px = 2 * pinhole.width, pinhole.height
        self.camera = camera
        self._reduced_px = (
            min(pinhole.width, max(1, round(pinhole.width * camera.fx / pinhole.fx))),
            min(pinhole.height, max(1, round(pinhole.height * camera.fy / pinhole.fy))),
        )
        self._columns, self._rows = self._places(eye)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return what the camera sees."""
        cv2 = self._cv2
        left = np.ascontiguousarray(image[:, : image.shape[1] // 2])
        reduced = cv2.resize(left, self._reduced_px, interpolation=cv2.INTER_AREA)
        return cv2.remap(
            reduced, self._columns, self._rows, interpolation=cv2.INTER_LINEAR
        )

    def _places(self, eye: EyeCalibration) -> tuple[np.ndarray, np.ndarray]:
        """Return the column and the row (h, w) of the reduced picture of each pixel."""
        camera, source = self.camera, eye.pinhole.resized(*self._reduced_px)
        x, y = ray_slopes(camera)
        k1, k2, _, _, k3, k4, k5, k6 = (*eye.distortion, 0.0, 0.0, 0.0)[:8]
        r = np.linspace(0, float(np.hypot(x, y).max()), 1000)
        with np.errstate(all="ignore"):  # an overflow is refused, too
            top = np.polynomial.Polynomial([1, k1, k2, k3])(r * r)
            below = np.polynomial.Polynomial([1, k4, k5, k6])(r * r)
            grows = (np.diff(r * top / below) > 0).all()
        if not ((below > 0).all() and grows):
            raise InputError(
                f"{eye.where}: distortion {eye.distortion} folds the image over itself "
                "where the camera looks; check the file, or take one that sees less"
            )
        matrix = np.array(
            [
                [source.fx, 0, source.cx - 0.5],
                [0, source.fy, source.cy - 0.5],
                [0, 0, 1],
            ]
        )
        points, _ = self._cv2.projectPoints(
            np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 1, 3),
            np.zeros(3),
            np.zeros(3),
            matrix,
            np.array(eye.distortion),
        )
        places = points.reshape(camera.height, camera.width, 2)
        last = np.array([source.width - 1, source.height - 1])
        beyond = float(np.maximum(-places, places - last).max())
        if not beyond <= 1:
            raise InputError(
                f"{eye.where}: the camera sees {beyond:.0f} px beyond the eye's picture"
                f" of {source.width} x {source.height} px; take one that sees less, "
                "such as the eye's own"
            )
        # up to a pixel beyond its edge is that edge
        inside = np.clip(places, 0, last).astype(np.float32)
        return inside[..., 0], inside[..., 1]
