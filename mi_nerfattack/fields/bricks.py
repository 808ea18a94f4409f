"""A field baked into bricks: fast to look up, without networks and derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import (
    AbstractField,
    box_metadata,
    check_box,
    check_positive,
    check_sky,
    sky_colour,
)
from mi_nerfattack.fields.occupancy import Occupancy

#: Subdivisions of a cell along each axis.
FINEST = 8
_LEVELS = (8, 4, 2, 1)
_LEVEL_SHIFT = 30  # of a pointer, whose lower bits say where a brick begins
MOST_VERTICES = (1 << _LEVEL_SHIFT) - 1
_TOP = 255.0
_LARGEST_LOG = 80.0  # its exponential is a number of single precision


def brick_starts(subdivisions: np.ndarray) -> np.ndarray:
    """Return where the vertices of bricks (n,) begin, (n + 1,): their number last."""
    return np.append(0, np.cumsum((subdivisions.astype(np.int64) + 1) ** 3))


def vertex_count(subdivisions: np.ndarray) -> int:
    """Return how many vertices bricks (n,) have together."""
    return int(brick_starts(subdivisions)[-1])


@dataclass(frozen=True)
class Codes:
    """How vertices keep density and colour in four bytes.

    The lowest byte is the logarithm of the density, from `low` (0) to `high` (255);
    then come red, green and blue, sRGB.

    Attributes:
        low: natural logarithm of the least density, 1/length unit.
        high: of the largest.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not -_LARGEST_LOG < self.low < self.high < _LARGEST_LOG:
            raise InputError(
                f"log_density: {self.low:g} to {self.high:g}; must rise, within "
                f"{-_LARGEST_LOG:g} to {_LARGEST_LOG:g}"
            )

    @staticmethod
    def of(step_m: float) -> Codes:
        """Return the range from a thousandth of a step's depth to a hundred."""
        return Codes(float(np.log(1e-3 / step_m)), float(np.log(1e2 / step_m)))

    def numbers(self, density: mi.Float, radiance: mi.Color3f) -> list[mi.Float]:
        """Return what vertices interpolate: four times (n,), 0 to 255."""
        logarithm = dr.log(dr.maximum(density, 1e-30))
        first = (logarithm - self.low) * (_TOP / (self.high - self.low))
        colour = dr.linear_to_srgb(mi.Color3f(radiance)) * _TOP
        numbers = first, colour.x, colour.y, colour.z
        return [dr.clip(mi.Float(x), 0, _TOP) for x in numbers]

    def quantities(self, numbers: list[mi.Float]) -> tuple[mi.Float, mi.Color3f]:
        """Return density and linear radiance of interpolated numbers."""
        first, *colour = numbers
        density = dr.exp(first * ((self.high - self.low) / _TOP) + self.low)
        return density, dr.srgb_to_linear(mi.Color3f(*colour) * (1 / _TOP))


def pack_word(numbers: list[mi.Float]) -> mi.UInt32:
    """Round four numbers (n,), 0 to 255, to the bytes of words."""
    word = mi.UInt32(0)
    for k, number in enumerate(numbers):
        word |= mi.UInt32(dr.round(dr.clip(number, 0, _TOP))) << (8 * k)
    return word


def unpack_word(word: mi.UInt32) -> list[mi.Float]:
    """Return the four numbers (n,) of words."""
    return [mi.Float(mi.Int32((word >> (8 * k)) & 255)) for k in range(4)]


class BrickField(AbstractField):
    """Density and colour at the vertices of bricks, one in each occupied cell.

    A brick divides its cell into n^3 parts, n = 1, 2, 4 or 8, and has (n + 1)^3
    vertices. What they keep (``Codes``) is interpolated trilinearly, and becomes
    density and radiance then. The radiance does not depend on the direction. Made by
    `fit.bake`; there is nothing to optimise.

    Not differentiable by the position: each brick rounds the values at its faces by
    itself, and neighbours may have other numbers of parts, so that density and radiance
    jump from brick to brick. Inside of a part, Dr.Jit's derivatives are right.

    Costs four bytes a vertex, and four a cell for where its brick begins.

    Args:
        lower: (3,) of the bounding box, metres.
        upper: (3,) of the bounding box, metres.
        occupancy: which cells have bricks.
        subdivisions: (bricks,), n of each occupied cell, in the order of the cells.
        vertices: (vertices,) uint32, brick by brick, z fastest.
        codes: what they mean.
        sky: (height, width, 3), raw colours of what lies behind, as an NGP's.
        step_m: marching step near the camera, metres.
        cone: growth of the step with distance.
        info: free metadata that is kept in the file.

    Raises:
        InputError: bricks and vertices do not belong together.
    """

    kind = "brick_field"
    has_sky = True
    differentiable_by_position = False

    def __init__(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        occupancy: Occupancy,
        subdivisions: np.ndarray,
        vertices: np.ndarray,
        codes: Codes,
        sky: np.ndarray,
        step_m: float,
        cone: float,
        info: dict[str, str] | None = None,
    ) -> None:
        self.lower: np.ndarray = np.asarray(lower, np.float64)
        self.upper: np.ndarray = np.asarray(upper, np.float64)
        check_box(self.lower, self.upper)
        self.step_m: float = float(step_m)
        self.cone: float = float(cone)
        check_positive("step_m", self.step_m)
        if not 0 <= self.cone <= 1:
            raise InputError(f"cone: {self.cone}; allowed is 0 to 1")
        check_bricks(int(occupancy.cells.sum()), subdivisions, vertices, sky=sky)
        self.codes = codes
        self.info: dict[str, str] = dict(info or {})
        self.occupy(occupancy)
        self.subdivisions = subdivisions.copy()
        self.vertices = upload(mi.UInt32, vertices)
        level = np.log2(FINEST // subdivisions).astype(np.uint32)
        # without a brick: one part, at the first vertex, and no density
        none = len(_LEVELS) - 1 << _LEVEL_SHIFT
        pointers = np.full(occupancy.shape, none, np.uint32)
        starts = brick_starts(subdivisions)[:-1]
        pointers[occupancy.cells] = starts | level << _LEVEL_SHIFT
        self._pointers = upload(mi.UInt32, pointers)
        self._sky_shape = sky.shape[0], sky.shape[1]
        self._sky = upload(mi.Float, sky)
        dr.make_opaque(self.vertices, self._pointers, self._sky)

    def corners(
        self, unit: mi.Point3f, active: mi.Bool
    ) -> list[tuple[mi.UInt32, mi.Float]]:
        """Return the eight vertices around points, and their weights.

        Args:
            unit: (3, n), positions in the unit box, in occupied cells.
            active: (n,) mask.
        """
        _, ry, rz = self.occupancy.shape
        cell, part = [], []
        for value, count in zip(unit, self.occupancy.shape, strict=True):
            scaled = dr.clip(value, 0, 1) * count
            lower = dr.minimum(dr.floor(dr.detach(scaled)), count - 1)
            cell.append(mi.UInt32(lower))
            part.append(scaled - lower)
        index = (cell[0] * ry + cell[1]) * rz + cell[2]
        pointer = dr.gather(mi.UInt32, self._pointers, index, active)
        n = mi.UInt32(FINEST) >> (pointer >> _LEVEL_SHIFT)
        strides = (n + 1) * (n + 1), n + 1, mi.UInt32(1)
        first = pointer & ((1 << _LEVEL_SHIFT) - 1)
        weights = []
        for value, stride in zip(part, strides, strict=True):
            scaled = value * mi.Float(n)
            lower = dr.minimum(dr.floor(dr.detach(scaled)), mi.Float(n) - 1)
            first += mi.UInt32(lower) * stride
            weights.append((1 - scaled + lower, scaled - lower))
        result = []
        for place in product((0, 1), repeat=3):
            vertex, weight = first, mi.Float(1)
            for k, stride, pair in zip(place, strides, weights, strict=True):
                vertex = vertex + stride if k else vertex
                weight = weight * pair[k]
            result.append((vertex, weight))
        return result

    def interpolate(
        self, corners: list[tuple[mi.UInt32, mi.Float]], active: mi.Bool
    ) -> list[mi.Float]:
        """Return the four numbers of `Codes` (n,) at points.

        Args:
            corners: from :meth:`corners`.
            active: (n,) mask.
        """
        result = [mi.Float(0) for _ in range(4)]
        for vertex, weight in corners:
            word = dr.gather(mi.UInt32, self.vertices, vertex, active)
            pairs = zip(unpack_word(word), result, strict=True)
            result = [dr.fma(weight, value, total) for value, total in pairs]
        return result

    def eval_everywhere(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """See :meth:`AbstractField.eval_everywhere`; anything without a brick."""
        del direction
        corners = self.corners(self.unit(point), active)
        density, radiance = self.codes.quantities(self.interpolate(corners, active))
        return density & active, radiance & active

    def density_bound(self) -> float:
        """Return the largest density of all vertices, which no point exceeds."""
        top = float(dr.max(self.vertices & 255)[0])
        none = mi.Float(0)
        return float(self.codes.quantities([mi.Float(top), none, none, none])[0][0])

    def background(self, direction: mi.Vector3f) -> mi.Color3f:
        """Interpolate the sky image bilinearly, (3, n), linear."""
        return sky_colour(self._sky, self._sky_shape, direction)

    def arrays(self) -> list[Any]:
        """See :meth:`AbstractField.arrays`."""
        return [*super().arrays(), self.vertices, self._pointers, self._sky]

    def tensors(self) -> dict[str, np.ndarray]:
        """Return vertices, subdivisions, sky, occupancy bits and octants."""
        return {
            "subdivisions": self.subdivisions,
            "vertices": self.vertices.numpy(),
            "sky": self._sky.numpy().reshape(*self._sky_shape, 3).copy(),
            **self.occupancy_tensors(),
        }

    def metadata(self) -> dict[str, str]:
        """Return bounds, units, codes and provenance."""
        return {
            **self.info,
            **box_metadata(self, self.info),
            "log_density": f"{self.codes.low!r} {self.codes.high!r}",
            "colour_space": "radiance = srgb_to_linear(byte / 255), linear Rec. 709",
        }


def check_bricks(
    bricks: int, subdivisions: np.ndarray, vertices: np.ndarray, sky: Any
) -> None:
    """Raise InputError unless arrays belong to as many bricks.

    Args:
        bricks: number of occupied cells.
        subdivisions: see :class:`BrickField`.
        vertices: see :class:`BrickField`.
        sky: see :class:`BrickField`.
    """
    if not bricks:
        raise InputError("occupancy: no cell is occupied; at least one has a brick")
    good = subdivisions.shape == (bricks,) and subdivisions.dtype == np.uint8
    if not good or not np.isin(subdivisions, _LEVELS).all():
        raise InputError(
            f"subdivisions: {subdivisions.dtype} {subdivisions.shape}; expected "
            f"({bricks},) bytes of 1, 2, 4 and 8"
        )
    expected = vertex_count(subdivisions)
    good = vertices.shape == (expected,) and vertices.dtype == np.uint32
    if not good or expected > MOST_VERTICES:
        raise InputError(
            f"vertices: {vertices.dtype} {vertices.shape}; expected ({expected},) "
            f"words, at most {MOST_VERTICES}"
        )
    check_sky(sky)
