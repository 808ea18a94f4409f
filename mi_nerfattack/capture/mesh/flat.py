"""Flat objects: a picture that stands upright or lies on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mi_nerfattack.capture.mesh.cube_faces import FLAT_FACES
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import FLAT
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.io import files

#: Pixels along an edge, at most: the lattice of a grid field is a cube.
MOST_PIXELS = 256

_THICKNESS = 0.01  # of the box, share of its longer edge,
_MOST_M = 0.04  # and metres, at most
_STEPS = 8  # of the march, through the sheet at right angles
_STEP_DEPTH = 12.0  # optical depth of a step, which is opaque
_RANGE = 1 / 512  # sRGB, from 0 and from 1, which no sigmoid reaches


def read_picture(path: str | Path) -> np.ndarray:
    """Read the picture of a flat object, as viewers show it.

    Returns:
        (h, w, 3), uint8 sRGB.

    Raises:
        InputError: it cannot be read, or pixels are transparent.
    """
    image = files.read_image(path, as_shown=True)
    if image.shape[2] == 4 and image[..., 3].min() < 255:
        raise InputError(
            f"{path}: has transparent pixels, and a flat object is opaque; save the "
            "picture on a background"
        )
    return image[..., :3]


@dataclass(frozen=True)
class FlatObject:
    """An opaque sheet that shows a picture.

    A *billboard* stands on z = 0 and faces -y, x to the right. A *patch* lies on z = 0
    and faces up: x to the right, the top of the picture at +y. So traffic along +y sees
    both upright. The other side of the sheet shows the picture mirrored.

    Args:
        kind: one of `FLAT_FACES`.
        width_m: along x.
        height_m: of the picture: along z (billboard) or y (patch).
        pixels_per_m: resolution along the longer edge. The other edge has as many
            pixels.

    Raises:
        InputError: an unknown kind, a size that is not positive, or more than
            `MOST_PIXELS` pixels along an edge.
    """

    kind: str
    width_m: float
    height_m: float
    pixels_per_m: float = 32.0

    def __post_init__(self) -> None:
        if self.kind not in FLAT_FACES:
            raise InputError(f"kind: {self.kind!r}; one of {', '.join(FLAT_FACES)}")
        for name in ("width_m", "height_m", "pixels_per_m"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(
                    f"{name}: {getattr(self, name)}; must be positive and finite"
                )
        if self.pixels > MOST_PIXELS:
            raise InputError(
                f"pixels_per_m: {self.pixels_per_m:g} give {self.pixels} pixels along "
                f"{self._longest:g} m; at most {MOST_PIXELS} are allowed, so take "
                f"{MOST_PIXELS / self._longest:.4g} or less"
            )

    @property
    def pixels(self) -> int:
        """Cells along each edge, between whose corners colours are interpolated."""
        return max(1, int(np.ceil(self._longest * self.pixels_per_m - 1e-6)))

    @property
    def _longest(self) -> float:
        return max(self.width_m, self.height_m)

    def field(self, picture: np.ndarray | None = None) -> GridField:
        """Make the field: one level, of which the layer at the face is occupied.

        Args:
            picture: (h, w, 3) uint8 sRGB, stretched over the sheet; None for grey.
        """
        width, height, thickness = self.width_m, self.height_m, self._thickness
        count = self.pixels
        cells = np.zeros((count,) * 3, bool)
        if self.kind == "billboard":
            size = np.array([width, thickness, height])
            lower = np.array([-width / 2, 0.0, 0.0])
            cells[:, 0] = True
        else:
            size = np.array([width, height, thickness])
            lower = np.array([-width / 2, -height / 2, 0.0])
            cells[:, :, -1] = True
        step = thickness / count / _STEPS
        field = GridField(
            GridLayout(1, count + 1, count + 1),
            lower,
            lower + size,
            occupancy=Occupancy(cells),
            density_scale=_STEP_DEPTH / step,
            step_m=step,
            info={FLAT: self.kind, "provenance.source": self.kind},
        )
        if picture is not None:
            field.set_parameter("texture", self._texture(picture, field))
        return field

    @property
    def _thickness(self) -> float:
        return min(_THICKNESS * self._longest, _MOST_M)

    def _texture(self, picture: np.ndarray, field: GridField) -> np.ndarray:
        """Return raw colours (n_vertices, 3) that show a picture, at any depth."""
        count = self.pixels
        # Halves of cells, the bottom row first; a vertex has the mean of its four
        size = 2 * count, 2 * count
        halves = Image.fromarray(picture).resize(size, Image.Resampling.BOX)
        padded = np.pad(np.asarray(halves)[::-1], ((1, 1), (1, 1), (0, 0)), "edge")
        colours = padded.reshape(count + 1, 2, count + 1, 2, 3).mean((1, 3)) / 255
        colours = colours.clip(_RANGE, 1 - _RANGE)
        raw = np.log(colours / (1 - colours)).astype(np.float32)
        side = count + 1
        depth = 1 if self.kind == "billboard" else 0  # of the axes z, y, x
        lattice = np.repeat(np.expand_dims(raw, depth), side, axis=depth)
        texture = np.zeros((field.n_vertices, 3), np.float32)
        texture[field.levels()[0].vertices] = lattice.reshape(-1, 3)
        return texture
