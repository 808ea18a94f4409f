"""Which colours an attacked object may have: projections, and a penalty.

All are of the colours c (sRGB) of the vertices that an attack steps in:

- a range: every value within `lowest` and `highest`, in a gamut (what a printer or
  monitor shows); c0 being the original colours, or the nearest to them that are so,
- boxes: every value within `linf` of c0, none changing in `fixed` regions;
- a ball: root mean square distance from c0 of at most `l2`, over the vertices that
  colour occupied cells;
- a penalty: `total_variation` times the mean absolute difference of neighbours there.

All but the penalty are kept after every step: values are clipped, drawn towards the
gamut's centre, then towards c0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_nerfattack.attack.texture.gamut import Gamut
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.levels import GridLevel
from mi_nerfattack.ranges import NonNegative, Positive, Share, checked

#: Colours stay so far from 0 and 1, where no raw value reaches.
MARGIN = 0.01
#: Differences below are penalised by their square.
_SMALL = 0.01

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
@checked("constraints")
class Constraints:
    """What colours are allowed.

    Attributes:
        linf: largest change of a value; None for any.
        l2: largest root mean square change; None for any.
        lowest, highest: range of all values, the original's too; by default the
            original's are allowed wherever they are.
        gamut: of a printer or monitor, the original's colours too.
        fixed: boxes (lower, upper) in the object's frame, metres, whose colours stay.
        total_variation: weight of the penalty, in units of the objective.

    Raises:
        InputError: an empty range or box, or a gamut whose centre is out of range.
    """

    linf: Positive | None = None
    l2: Positive | None = None
    lowest: Share | None = None
    highest: Share | None = None
    gamut: Gamut | None = None
    fixed: tuple[Box, ...] = ()
    total_variation: NonNegative = 0.0

    @property
    def are_set(self) -> bool:
        """Whether any of them is set."""
        limits = self.linf, self.l2, self.lowest, self.highest, self.gamut
        has_limit = any(limit is not None for limit in limits)
        return has_limit or bool(self.fixed) or self.total_variation > 0

    def __post_init__(self) -> None:
        lowest = max(self.lowest or 0.0, MARGIN)
        highest = min(1.0 if self.highest is None else self.highest, 1 - MARGIN)
        named = f"lowest: {self.lowest}, highest: {self.highest}"
        if lowest >= highest:
            raise InputError(
                f"{named}; expected lowest < highest, {MARGIN} from 0 and 1"
            )
        # Colours are drawn towards the gamut's centre, so the centre must be allowed
        if self.gamut is not None:
            centre = self.gamut.centre
            if not lowest < centre.min() <= centre.max() < highest:
                raise InputError(
                    f"{named}; the gamut's centre, {centre.round(2).tolist()}, is not "
                    "within"
                )
        for lower, upper in self.fixed:
            if not np.less(lower, upper).all():
                raise InputError(f"fixed: {lower} to {upper}; expected lower < upper")


class Allowed:
    """The constraints on the colours of one level of a field.

    Args:
        constraints: what is allowed.
        field: of the object.
        level: whose vertices' colours they are.
        original: (n, 3) sRGB, by vertex.

    Raises:
        InputError: a fixed region misses the object.

    Attributes:
        start: (n, 3) float32, the allowed colours nearest to the original.
    """

    def __init__(
        self,
        constraints: Constraints,
        field: GridField,
        level: GridLevel,
        original: np.ndarray,
    ) -> None:
        self.constraints, n = constraints, level.resolution
        self._counts = _colouring(field, level)
        self._cube = (n, n, n, 3)
        low, high = constraints.lowest, constraints.highest
        # The range; by default it includes the original colours, wherever they are
        self._lower = np.minimum(original, np.float32(MARGIN))
        self._upper = np.maximum(original, np.float32(1 - MARGIN))
        if low is not None:
            self._lower = np.full_like(original, max(low, MARGIN))
        if high is not None:
            self._upper = np.full_like(original, min(high, 1 - MARGIN))
        # The start: the original colours, moved into the range and into the gamut
        self.start: np.ndarray = np.clip(original, self._lower, self._upper)
        if gamut := constraints.gamut:
            self.start = gamut.draw(self.start, gamut.centre).astype(np.float32)
        # A box around the start; in fixed regions, the start alone
        if constraints.linf is not None:
            self._lower = np.maximum(self._lower, self.start - constraints.linf)
            self._upper = np.minimum(self._upper, self.start + constraints.linf)
        voxel = (field.upper - field.lower) / level.scale
        for lower, upper in constraints.fixed:
            where = vertex_points(field, level)
            # whatever is interpolated inside
            inside = (where > lower - voxel) & (where < upper + voxel)
            inside = inside.all(axis=1)
            if not inside.any():
                raise InputError(
                    f"fixed: {lower} to {upper}; the object lies in "
                    f"{field.lower.tolist()} to {field.upper.tolist()}"
                )
            self._lower[inside] = self._upper[inside] = self.start[inside]

    def project(self, value: np.ndarray) -> np.ndarray:
        """Return colours (n, 3) that are allowed, near to given ones."""
        value = np.clip(value, self._lower, self._upper)
        if gamut := self.constraints.gamut:
            # Into the gamut, then into the boxes; the second step may leave the gamut
            value = gamut.draw(value, gamut.centre)
            value = np.clip(value, self._lower, self._upper)
            # Towards the start, which lies in gamut and boxes; both are convex
            value = gamut.draw(value, self.start).astype(np.float32)
        if self.constraints.l2 is None:
            return value
        # The ball: the change of all colours shrinks by one factor
        change = value - self.start
        square = np.square(change[self._counts], dtype=np.float64).mean()
        size = float(np.sqrt(square))
        if size <= self.constraints.l2:
            return value
        return self.start + np.float32(self.constraints.l2 / size) * change

    def penalty(self, value: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the weighted total variation, and its gradient (n, 3).

        Args:
            value: (n, 3) colours.
        """
        weight = self.constraints.total_variation
        gradient = np.zeros(self._cube, np.float32)
        if weight == 0.0:
            return 0.0, gradient.reshape(value.shape)
        cube, counted = value.reshape(self._cube), self._counts.reshape(self._cube[:3])
        total, pairs = 0.0, 0
        for axis in range(3):
            first, second = neighbours(axis)
            both = (counted[first] & counted[second])[..., None]
            change = np.where(both, cube[second] - cube[first], 0)
            # The absolute difference, rounded by a parabola around 0
            small = np.abs(change) < _SMALL
            size = np.where(small, change**2 / (2 * _SMALL) + _SMALL / 2, abs(change))
            total += float(size[np.broadcast_to(both, size.shape)].sum())
            pairs += 3 * int(both.sum())
            slope = np.where(small, change / _SMALL, np.sign(change))
            gradient[second] += slope
            gradient[first] -= slope
        share = weight / max(pairs, 1)
        return share * total, (share * gradient).reshape(value.shape)


def neighbours(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return which entries of a cube have one behind them along an axis, and those."""
    first, second = [slice(None)] * 3, [slice(None)] * 3
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    return tuple(first), tuple(second)


def vertex_points(
    field: GridField, level: GridLevel, chosen: np.ndarray | None = None
) -> np.ndarray:
    """Return where a level's vertices lie, (k, 3), metres, x the fastest.

    Args:
        field: of the level.
        level: one of `field.levels()`.
        chosen: (n, n, n) by z, y, x, of bool; all vertices by default.
    """
    if chosen is None:
        chosen = np.ones((level.resolution,) * 3, bool)
    unit = np.argwhere(chosen)[:, ::-1] / level.scale
    return field.lower + unit * (field.upper - field.lower)


def _colouring(field: GridField, level: GridLevel) -> np.ndarray:
    """Tell which vertices have a part in the colour of an occupied cell, (n,)."""
    occupied = field.window.cells.transpose()  # by z, y, x
    index = np.arange(level.resolution)
    for axis, count in enumerate(occupied.shape):
        # A vertex colours the cells between its two neighbours on this axis
        first = np.floor((index - 1) / level.scale * count).clip(0, count - 1)
        last = np.ceil((index + 1) / level.scale * count).clip(1, count)
        ranges = zip(first.astype(int), last.astype(int), strict=True)
        slabs = [occupied.take(range(a, b), axis).any(axis) for a, b in ranges]
        occupied = np.stack(slabs, axis)
    return np.asarray(occupied.ravel(), bool)
