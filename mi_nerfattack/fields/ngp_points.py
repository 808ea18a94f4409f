"""Gradients of an NGP's parameters at many points, by products of matrices.

Points are collected in a kernel first; then the networks run over batches of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.base import AbstractPoints
from mi_nerfattack.fields.ngp_matrices import (
    add_gradient,
    apply,
    column,
    lay_out,
    matrices,
    some_rows,
)

if TYPE_CHECKING:
    from mi_nerfattack.fields.ngp import NGPField

CHUNK = 1 << 14  # points whose activations exist at a time, 20 MB at width 64
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
        return *self.field.decode(features, direction), (features, unit)

    def append(
        self,
        place: Any,
        d_density: mi.Float,
        d_radiance: mi.Color3f,
        ray: mi.UInt32,
        active: mi.Bool,
    ) -> None:
        """See :meth:`AbstractPoints.append`."""
        features, unit = place
        slot = dr.scatter_inc(self._counter, mi.UInt32(0), active)
        active = active & (slot < self.capacity)
        numbers = mi.ArrayXf([*unit, d_density, *d_radiance, mi.Float(0)])
        dr.scatter(self._features, mi.ArrayXf(features), slot, active)
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
        harmonics = lay_out(dr.sh_eval(towards, field.sh_order))
        given = [mi.Float(numbers[k]) for k in range(3, 7)]
        unit = mi.Point3f(numbers[0], numbers[1], numbers[2])
        dr.eval(harmonics, given, unit)
        slopes = _differentiate(field, self._features, harmonics, given)
        if dr.grad_enabled(field.encoding.data):
            _scatter(field, unit, slopes)


def _differentiate(
    field: NGPField, features: mi.Float, harmonics: mi.Float, given: list[mi.Float]
) -> mi.Float:
    """Accumulate the weights' gradients; return the derivatives by the features."""
    count, size = dr.width(given[0]), field.encoding.n_output_features
    nets = (field.density_net, field.colour_net)
    weights = [matrices(net) for net in nets]
    for net, own in zip(nets, weights, strict=True):
        if dr.grad_enabled(net["weights"]):
            dr.enable_grad(own)
    slopes = dr.zeros(mi.Float, count * size)
    for start in range(0, count, CHUNK):
        first, height = dr.opaque(mi.UInt32, start), min(CHUNK, count - start)
        x = some_rows(features, first, height, size)
        view = some_rows(harmonics, first, height, dr.width(harmonics) // count)
        dr.enable_grad(x)
        geometry = apply(weights[0], x)
        raw = apply(weights[1], dr.concat([geometry, view], axis=1))
        values = field.activate(
            column(geometry, 0), [column(raw, c) for c in range(3)]
        )
        row = first + dr.arange(mi.UInt32, height)
        parts = [
            value * dr.gather(mi.Float, cotangent, row)
            for value, cotangent in zip((values[0], *values[1]), given, strict=True)
        ]
        dr.backward(sum(parts, mi.Float(0)))
        by_x = dr.grad(x).array
        dr.scatter(slopes, by_x, first * size + dr.arange(mi.UInt32, dr.width(by_x)))
        dr.eval(slopes)
    for net, own in zip(nets, weights, strict=True):
        if dr.grad_enabled(net["weights"]):
            add_gradient(net, own)
    return slopes


def _scatter(field: NGPField, unit: mi.Point3f, slopes: mi.Float) -> None:
    """Differentiate the encoding, given the derivatives by its features, row by row."""
    features = [mi.Float(x) for x in field.encoding(unit, mi.Bool(True))]
    size, count = len(features), dr.width(unit)
    index = dr.arange(mi.UInt32, count)
    given = dr.gather(mi.ArrayXf, slopes, index, shape=(size, count))
    parts = (feature * given[k] for k, feature in enumerate(features))
    dr.backward_from(sum(parts, mi.Float(0)))
