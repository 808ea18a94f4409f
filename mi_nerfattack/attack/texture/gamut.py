"""Colours that a printer or monitor can show: a convex hull, in sRGB."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageCms
from scipy.spatial import ConvexHull, QhullError

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

MAX_BYTES = 1 << 24
PROFILES = (".icc", ".icm")
#: Steps along each ink or channel at which a profile is sampled.
_SAMPLES = 6
_CHUNK = 1 << 14
_INWARDS = 1 - 1e-4


class Gamut:
    """The convex hull of colours.

    What patches of some colours reproduce, mixtures of them do, too: by halftone dots
    on paper, by brightness on a monitor, to the accuracy that both are mixed in sRGB.

    Args:
        points: (k, 3) sRGB in 0 to 1, not in one plane.

    Attributes:
        centre: (3,), mean of the hull's corners.

    Raises:
        InputError: fewer than four colours, or all in one plane.
    """

    def __init__(self, points: np.ndarray) -> None:
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError) as err:
            raise InputError(
                f"gamut: {len(points)} colours span no volume; expected four or more "
                "that do not lie in one plane"
            ) from err
        self._normals, self._offsets = hull.equations[:, :3], hull.equations[:, 3]
        self.centre = points[hull.vertices].mean(axis=0)

    @staticmethod
    def load(path: Path) -> Gamut:
        """Read a gamut.

        Args:
            path: an ICC profile (``.icc``, ``.icm``) of RGB or CMYK, or a text of sRGB
                colours with three numbers per line. The profile is sampled by its
                relative colorimetric intent. The numbers are in 0 to 1 or, if any is
                larger, in 0 to 255.

        Raises:
            InputError: file missing, damaged or of another kind.
        """
        data = files.read_bytes(path, MAX_BYTES)
        is_profile = path.suffix.lower() in PROFILES
        points = _of_profile(path, data) if is_profile else _of_text(path, data)
        try:
            return Gamut(points)
        except InputError as err:
            raise InputError(f"{path}: {err}") from err

    def draw(self, colours: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """Draw colours (n, 3) into the hull, those in it staying as they are.

        Args:
            colours: sRGB.
            inside: (n, 3) or (3,), in the hull: what each is drawn towards.
        """
        inside = np.broadcast_to(inside, colours.shape)
        drawn = colours.copy()
        [moved] = (colours != inside).any(axis=1).nonzero()
        # In chunks, because every colour is compared with every plane of the hull
        for some in np.array_split(moved, len(moved) // _CHUNK + 1):
            # Signed distances to the hull's planes, positive outside
            near = inside[some] @ self._normals.T + self._offsets
            far = colours[some] @ self._normals.T + self._offsets
            # The first plane on the way from inside
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(far > 0, np.maximum(-near, 0) / (far - near), 1.0)
            least = share.min(axis=1, initial=1.0)[:, None]
            # A little further inwards, so that rounding leaves no colour outside
            least = np.where(least < 1, _INWARDS * least, 1.0)
            drawn[some] = np.where(
                least < 1,
                inside[some] + least * (colours[some] - inside[some]),
                colours[some],
            )
        return drawn


def _of_profile(path: Path, data: bytes) -> np.ndarray:
    try:
        profile: Any = ImageCms.ImageCmsProfile(io.BytesIO(data))
        mode = profile.profile.xcolor_space.strip()
        if mode not in ("RGB", "CMYK"):
            raise InputError(f"{path}: a profile of {mode}; expected RGB or CMYK")
        transform = ImageCms.buildTransform(
            profile,
            ImageCms.createProfile("sRGB"),
            mode,
            "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
        )
    except (ImageCms.PyCMSError, OSError, UnicodeDecodeError) as err:
        raise InputError(f"{path}: no ICC profile of a device: {err}") from err
    levels = np.linspace(0, 255, _SAMPLES).round().astype(np.uint8)
    samples = np.array([list(itertools.product(levels, repeat=len(mode)))])
    shown = ImageCms.applyTransform(Image.fromarray(samples, mode), transform)
    assert shown is not None, "only transforms in place give nothing"
    return np.asarray(shown)[0] / 255


def _of_text(path: Path, data: bytes) -> np.ndarray:
    expected = "expected three numbers in 0 to 255 a line, or an .icc profile"
    try:
        lines = data.decode().replace(",", " ").splitlines()
        points = np.array([line.split() for line in lines if line.strip()], float)
    except ValueError as err:
        raise InputError(f"{path}: {err}; {expected}") from err
    is_valid = points.shape[1:] == (3,) and np.isfinite(points).all()
    if not is_valid or points.min() < 0 or points.max() > 255:
        raise InputError(f"{path}: no list of colours; {expected}")
    return points / 255 if points.max() > 1 else points
