"""An object from its six sides: orthographic pictures, as a cube map is laid out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import straight_rgba
from mi_nerfattack.capture.mesh.mesh import CUBE_FACES
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.io import files
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

_LONGEST_PX = 256
_MAX_PX = 8192
OBJECT_BOX = ("provenance.object_lower", "provenance.object_upper")
"""Header entries of the box of the object that a field was fitted to."""


@dataclass(frozen=True, eq=False)
class CubeFaces:
    """Six pictures of an object.

    Attributes:
        lower, upper: (3,), box whose sides are shown, metres.
        pixels_per_m: of all pictures.
        images: by the names of `CUBE_FACES`: (height, width, 4), uint8 sRGB, alpha
            not premultiplied.
    """

    lower: np.ndarray
    upper: np.ndarray
    pixels_per_m: float
    images: dict[str, np.ndarray]


def object_box(field: GridField) -> tuple[np.ndarray, np.ndarray]:
    """Return the box of the object that a field was fitted to, (3,) each, metres.

    It stands in the header of fields that `asset` made; for others it is the field's.
    """
    corners = []
    for name, default in zip(OBJECT_BOX, (field.lower, field.upper), strict=True):
        try:
            corner = np.array(field.info[name].split(), np.float64)
        except KeyError:
            corner = default
        except ValueError as error:
            raise InputError(f"header entry '{name}': {error}") from error
        corners.append(corner)
    lower, upper = corners
    if lower.shape != (3,) or upper.shape != (3,) or not np.all(lower < upper):
        raise InputError(
            f"header entries {', '.join(OBJECT_BOX)}: {lower} to {upper}; no box"
        )
    return lower, upper


def render_faces(field: GridField, pixels_per_m: float | None = None) -> CubeFaces:
    """Look at an object from its six sides without perspective.

    Args:
        field: the object.
        pixels_per_m: of the pictures; None for 256 along the longest edge.

    Raises:
        InputError: the pictures would have no pixel or too many.
    """
    lower, upper = object_box(field)
    longest = float((upper - lower).max())
    scale = _LONGEST_PX / longest if pixels_per_m is None else pixels_per_m
    if not 0 < scale * longest <= _MAX_PX:
        raise InputError(
            f"pixels_per_m: {pixels_per_m}; must be positive and, for an object of "
            f"{longest:.3f} m, at most {_MAX_PX / longest:.0f}"
        )
    posed = PosedField(field)
    images = {
        name: _render(posed, lower, upper, scale, axes)
        for name, axes in CUBE_FACES.items()
    }
    return CubeFaces(lower, upper, scale, images)


def write_faces(folder: str | Path, faces: CubeFaces) -> None:
    """Write px.png to nz.png and, last, faces.json, which says what they show."""
    root = files.make_folder(folder)
    table = {
        "lower_m": faces.lower.tolist(),
        "upper_m": faces.upper.tolist(),
        "edges_m": (faces.upper - faces.lower).tolist(),
        "pixels_per_m": faces.pixels_per_m,
        "colour_space": "sRGB; radiance, that is reflectance times the captured light",
        "view": "orthographic, from outside",
        "faces": {
            name: {
                "file": f"{name}.png",
                "outward_normal": list(normal),
                "right_of_picture": list(right),
                "top_of_picture": list(top),
                "width_px": faces.images[name].shape[1],
                "height_px": faces.images[name].shape[0],
            }
            for name, (normal, right, top) in CUBE_FACES.items()
        },
    }
    for name, image in faces.images.items():
        files.write_image(root / f"{name}.png", image)
    files.write_json(root / "faces.json", table)


def _render(
    posed: PosedField, lower: np.ndarray, upper: np.ndarray, scale: float, axes: Any
) -> np.ndarray:
    normal, right, up = map(np.array, axes)
    extent, middle = upper - lower, 0.5 * (lower + upper)
    across, high = float(abs(right @ extent)), float(abs(up @ extent))
    width, height = (max(1, round(scale * edge)) for edge in (across, high))
    column = ((np.arange(width) + 0.5) / width - 0.5) * across
    row = (0.5 - (np.arange(height) + 0.5) / height) * high
    away = float(
        np.abs(np.stack([posed.field.lower, posed.field.upper]) - middle).max()
    )
    eye = middle + 1.1 * away * normal
    origin = eye + row[:, None, None] * up + column[:, None] * right
    half = mi.Float(0.5)
    dr.make_opaque(half)
    with dr.suspend_grad():
        rays = Rays(
            mi.Point3f(np.ascontiguousarray(origin.reshape(-1, 3).T, np.float32)),
            mi.Vector3f(*map(float, -normal)),
            jitter=half,
        )
        seen = march(posed, rays)
        dr.eval(seen)
    return straight_rgba(
        seen.radiance.numpy().T.reshape(height, width, 3),
        seen.opacity.numpy().reshape(height, width, 1),
    )
