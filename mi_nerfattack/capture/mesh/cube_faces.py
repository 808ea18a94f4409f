"""An object from its six sides: orthographic pictures, as a cube map is laid out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import straight_rgba
from mi_nerfattack.capture.mesh.mesh import CUBE_FACES, MeshPart, TexturedMesh
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import FLAT
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.io import files
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

_LONGEST_PX = 256
_MAX_PX = 8192
_COARSE_PX = 32  # of a side that is looked at for its shape
_RIM_PX = 3
_FLAT_VOXELS = 5  # how far a fitted surface lies from the object's
OBJECT_BOX = ("provenance.object_lower", "provenance.object_upper")
"""Header entries of the box of the object that a field was fitted to."""
FLAT_FACES = {"billboard": "ny", "patch": "pz"}
"""Which face of the box shows the picture, as `CUBE_FACES` names it, by kind."""


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


def sheet_mesh(field: GridField) -> TexturedMesh | None:
    """Return the face of a flat object that shows the picture; None for other fields.

    Raises:
        InputError: the field's header names no kind of flat object.
    """
    kind = field.info.get(FLAT)
    if kind is None:
        return None
    if kind not in FLAT_FACES:
        raise InputError(
            f"header entry '{FLAT}' is {kind!r}; allowed: {', '.join(FLAT_FACES)}"
        )
    normal, right, up = np.array(CUBE_FACES[FLAT_FACES[kind]], np.float64)
    sides = np.array([-right - up, right - up, right + up, -right + up])
    middle, half = (field.lower + field.upper) / 2, (field.upper - field.lower) / 2
    part = MeshPart(middle + half * (normal + sides), np.array([[0, 1, 2], [0, 2, 3]]))
    return TexturedMesh(kind, (part,))


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
        name: _render(posed, lower, upper, scale=scale, axes=axes)
        for name, axes in CUBE_FACES.items()
    }
    return CubeFaces(lower, upper, scale, images=images)


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


def flat_share(field: GridField) -> float:
    """Return how much of the sides of an object's box is its surface, of 1.

    1 for a box whatever its colours; a ball covers a part of its box's sides, and lies
    behind most of that. A tenth at each rim does not count, where a coarse grid fades,
    nor does the underside, which no view has shown of what stands on the ground.
    """
    lower, upper = object_box(field)
    posed, voxel = PosedField(field), _voxel(field)
    good = []
    for axes in [axes for name, axes in CUBE_FACES.items() if name != "nz"]:
        integrals, distance = _look(
            posed, lower, upper, axes=axes, shape=(_COARSE_PX, _COARSE_PX)
        )
        opacity, moment = integrals.opacity.numpy(), integrals.moment.numpy()
        depth = moment / np.maximum(opacity, 1e-6)
        flat = np.abs(depth - distance) < _FLAT_VOXELS * voxel
        surface = ((opacity > 0.5) & flat).reshape(_COARSE_PX, _COARSE_PX)
        good.append(surface[_RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX])
    return float(np.mean(good))


def _voxel(field: GridField) -> float:
    return float((field.upper - field.lower).max()) / field.layout.max_resolution


def _render(
    posed: PosedField, lower: np.ndarray, upper: np.ndarray, scale: float, axes: Any
) -> np.ndarray:
    _, right, up = np.abs(np.array(axes))
    extent = upper - lower
    width, height = (max(1, round(scale * float(v @ extent))) for v in (right, up))
    integrals, _ = _look(posed, lower, upper, axes=axes, shape=(height, width))
    return straight_rgba(
        integrals.radiance.numpy().T.reshape(height, width, 3),
        integrals.opacity.numpy().reshape(height, width, 1),
    )


def _look(
    posed: PosedField,
    lower: np.ndarray,
    upper: np.ndarray,
    axes: Any,
    shape: tuple[int, int],
) -> tuple[March, float]:
    """March (height * width) rays against one side; also the distance to it, metres."""
    normal, right, up = map(np.array, axes)
    (height, width), extent, middle = shape, upper - lower, 0.5 * (lower + upper)
    across, high = float(abs(right @ extent)), float(abs(up @ extent))
    column = ((np.arange(width) + 0.5) / width - 0.5) * across
    row = (0.5 - (np.arange(height) + 0.5) / height) * high
    away = 1.1 * float(
        np.abs(np.stack([posed.field.lower, posed.field.upper]) - middle).max()
    )
    eye = middle + away * normal
    origin = eye + row[:, None, None] * up + column[:, None] * right
    half = mi.Float(0.5)
    dr.make_opaque(half)
    with dr.suspend_grad():
        rays = Rays(
            mi.Point3f(np.ascontiguousarray(origin.reshape(-1, 3).T, np.float32)),
            mi.Vector3f(*map(float, -normal)),
            jitter=half,
        )
        integrals = march(posed, rays)
        dr.eval(integrals)
    return integrals, away - 0.5 * float(abs(normal @ extent))
