"""Gradients of an NGP's parameters at many points, by products of matrices.

Points are collected in a kernel first; then the networks run over batches of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.base import AbstractPoints
from mi_nerfattack.fields.cpu.rows import (
    SharedRows,
    add_gradients,
    columns,
    lay_out,
    networks,
    rows,
    scatter,
)

if TYPE_CHECKING:
    from mi_nerfattack.fields.ngp import NGPField

_NUMBERS = 8  # position, derivatives by density and radiance, one spare


class NGPPoints(AbstractPoints):
    """Points with the derivatives of an objective by density and radiance there.

    Args:
        field: the field.
        capacity: points that fit.
    """

    def __init__(self, field: NGPField, capacity: int) -> None:
        self.field = field
        self.capacity = capacity
        self._features = dr.zeros(mi.Float, capacity * field.encoding.n_output_features)
        self._numbers = dr.zeros(mi.Float, capacity * _NUMBERS)
        self._ray = dr.zeros(mi.UInt32, capacity)
        self._counter = dr.zeros(mi.UInt32, 1)
        dr.make_opaque(self._features, self._numbers, self._ray, self._counter)

    def eval(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f, Any]:
        """See :meth:`AbstractPoints.eval`."""
        unit = self.field.clipped(point)
        features = [mi.Float(x) for x in self.field.encoding(unit, active)]
        density, radiance = self.field.decode(features, direction)
        factor = self.field.window(self.field.unit(point), active)
        return density * factor, radiance, (features, point, factor)

    def append(
        self,
        evaluated: Any,
        d_density: mi.Float,
        d_radiance: mi.Color3f,
        ray: mi.UInt32,
        active: mi.Bool,
    ) -> None:
        """See :meth:`AbstractPoints.append`."""
        features, point, factor = evaluated
        d_density = factor * d_density  # by what the network gives
        slot = dr.scatter_inc(self._counter, mi.UInt32(0), active)
        active = active & (slot < self.capacity)
        numbers = mi.ArrayXf([*point, d_density, *d_radiance, mi.Float(0)])  # pyright: ignore[reportCallIssue]
        dr.scatter(self._features, mi.ArrayXf(features), slot, active)  # pyright: ignore[reportCallIssue]
        dr.scatter(self._numbers, numbers, slot, active)
        dr.scatter(self._ray, ray, slot, active)

    def count(self) -> int:
        """See :meth:`AbstractPoints.count`."""
        dr.eval(self._features, self._numbers, self._ray, self._counter)
        return int(self._counter[0])

    def accumulate(self, heading: mi.Vector3f) -> None:
        """See :meth:`AbstractPoints.accumulate`."""
        count, field = self.count(), self.field
        if count == 0:
            return
        index = dr.arange(mi.UInt32, count)
        numbers = dr.gather(mi.ArrayXf, self._numbers, index, shape=(_NUMBERS, count))
        towards = dr.gather(
            mi.Vector3f, heading, dr.gather(mi.UInt32, self._ray, index)
        )
        view = lay_out(dr.sh_eval(towards, field.sh_order))
        given = [mi.Float(numbers[k]) for k in range(3, 7)]
        point = mi.Point3f(numbers[0], numbers[1], numbers[2])
        dr.eval(view, given, point)
        size = field.encoding.n_output_features
        features = rows(self._features, size)[:count]
        nets, raw = networks(field), SharedRows(count, 4)
        nets.forward(features, rows(view, dr.width(view) // count), raw.view)
        slopes = SharedRows(count, size)
        by_raw = _differentiate(field, raw.array, given)
        add_gradients(field, nets.backward(rows(by_raw, 4), slopes.view))
        if dr.grad_enabled(field.encoding.data):
            scatter(field, point, slopes.array)


def _differentiate(field: NGPField, raw: mi.Float, given: list[mi.Float]) -> mi.Float:
    """Return the derivatives by raw density and colours, row by row, (4 n,)."""
    leaf = mi.Float(raw)
    dr.enable_grad(leaf)
    raw_density, *raw_colour = columns(leaf, 4)
    density, colour = field.activate(raw_density, raw_colour)
    parts = zip((density, *colour), given, strict=True)
    dr.backward_from(sum((value * slope for value, slope in parts), mi.Float(0)))
    result = dr.grad(leaf)
    dr.eval(result)
    return result
