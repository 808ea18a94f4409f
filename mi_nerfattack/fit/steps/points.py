"""One step of a fit of an NGP on a CPU, in a few wide launches recorded once."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.arrays import vjp
from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.fields.cpu.networks import (
    SharedRows,
    add_gradients,
    columns,
    lay_out,
    networks,
    rows,
    scatter,
)
from mi_nerfattack.fields.ngp import NGPField
from mi_nerfattack.fit.batch import STOP, BatchSource, Draw, Score
from mi_nerfattack.fit.steps.samples import (
    Samples,
    Spread,
    composite,
    cotangents,
    keep_visible,
    list_samples,
    measure_spread,
)
from mi_nerfattack.render.march import private_gradients
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays


class PointStep:
    """Gradients of an NGP by a batch of rays.

    Samples are listed by occupancy; the density network runs over all of them; those
    that light reaches the eye from go on to the colours and to the derivative. The
    networks are products of matrices between launches of fixed width: no step takes
    another kernel than the first.

    Where poses are learned, the dependence of colours and of the sky on direction is
    left out of their derivative.

    Args:
        field: the NGP, at the identity pose.
        source: of rays, and of the loss.
        listed: room for samples before visibility is known.
        visible: room for samples that are seen.
    """

    def __init__(
        self, field: NGPField, source: BatchSource, listed: int, visible: int
    ) -> None:
        self.field, self.source = field, source
        self.posed = PosedField(field)
        self.listed, self.visible = listed, visible
        size = field.encoding.n_output_features
        self._raw_density = SharedRows(listed, 1)
        self._raw = SharedRows(visible, 4)
        self._slopes = SharedRows(visible, size)
        self._list = freeze_method(self._record_list, self._state)
        self._keep = freeze_method(self._record_keep, self._state)
        self._compare = freeze_method(self._record_compare, self._state)
        self._scatter = freeze_method(self._record_scatter, self._state)

    def __call__(self, random: Any, limit: mi.UInt32) -> tuple[Score, Any]:
        """See :class:`~mi_nerfattack.fit.steps.march.MarchStep`, called alike."""
        size = self.field.encoding.n_output_features
        nets = networks(self.field)
        draw, listed, features, random = self._list(random, limit)
        used = int(dr.sum(listed.count)[0])
        nets.raw_density(rows(features, size)[:used], self._raw_density.view[:used, 0])
        samples, features, view = self._keep(
            draw.rays, listed, features, self._raw_density.array
        )
        wide = dr.width(view) // self.visible
        nets.forward(rows(features, size), rows(view, wide), self._raw.view)
        score, slopes, by_window = self._compare(draw, samples, self._raw.array)
        score.listed = dr.sum(listed.count)
        add_gradients(self.field, nets.backward(rows(slopes, 4), self._slopes.view))
        self._scatter(draw, samples, self._slopes.array, by_window)
        return score, random

    def _state(self, *arguments: Any) -> list[Any]:
        return [self, self.posed.state(), self.field.parameters(), self.source.state()]

    def _record_list(self, random: Any, limit: mi.UInt32) -> tuple[Any, ...]:
        draw = self.source.draw(random, limit)
        with dr.suspend_grad():
            listed = list_samples(self.posed, draw.rays, self.listed)
            unit = self.field.clipped(_points(draw.rays, listed))
            used = dr.arange(mi.UInt32, self.listed) < dr.sum(listed.count)
            features = lay_out(_encode(self.field, unit, used))
        return draw, listed, features, random

    def _record_keep(
        self, rays: Rays, listed: Samples, features: mi.Float, raw: mi.Float
    ) -> tuple[Samples, mi.Float, mi.Float]:
        with dr.suspend_grad():
            depths = self.field.activate(raw, [raw, raw, raw])[0] * listed.width
            dr.eval(depths)
            samples, slots = keep_visible(listed, depths, STOP, capacity=self.visible)
            heading = mi.Vector3f(
                *(dr.gather(mi.Float, x, samples.ray) for x in rays.direction)
            )
            view = lay_out(dr.sh_eval(heading, self.field.sh_order))
            shape = (self.field.encoding.n_output_features, self.visible)
            rows = dr.gather(mi.ArrayXf, features, slots, shape=shape)
            return samples, lay_out(rows), view

    def _record_compare(
        self, draw: Draw, samples: Samples, raw: mi.Float
    ) -> tuple[Score, mi.Float, mi.Float]:
        def activate(raw: mi.Float) -> tuple[mi.Float, mi.Color3f]:
            raw_density, *raw_colour = columns(raw, 4)
            density, colour = self.field.activate(raw_density, raw_colour)
            return density * samples.width, colour

        values, colours = dr.detach(activate(raw))
        dr.eval(values, colours)
        with dr.suspend_grad():
            primal = composite(samples, values, colours)
            dr.eval(primal)
        score, cotangent = self.source.compare(draw, primal, samples.fits)
        score.visible = dr.sum(samples.count)
        with dr.suspend_grad():
            spread = self._spread(samples, values)
            by_depth, by_colour = cotangents(
                samples,
                values,
                colours,
                primal=primal,
                cotangent=cotangent,
                spread=spread,
            )
            score.loss += dr.sum(spread.penalty) * self.source.weights.spread
            dr.eval(by_depth, by_colour)
        slopes = vjp(activate, raw, (by_depth, by_colour))
        return score, slopes, by_depth * values

    def _spread(self, samples: Samples, depths: mi.Float) -> Spread:
        """Measure spread in steps of the march, as a share of those across the box."""
        corners = mi.Vector3f(*map(float, self.field.upper - self.field.lower))
        width = dr.rcp(self.posed.lattice_index(mi.Float(dr.norm(corners))))
        position = self.posed.lattice_index(samples.t) * width
        rays = dr.maximum(dr.count(samples.fits), 1)
        factor = self.source.weights.spread * dr.rcp(mi.Float(rays))
        return measure_spread(samples, depths, position, width, factor)

    def _record_scatter(
        self, draw: Draw, samples: Samples, slopes: mi.Float, by_window: mi.Float
    ) -> None:
        """Differentiate by table and poses; `by_window` (m,) is by its logarithm."""
        point = _points(draw.rays, samples)
        if self.source.learns_poses:
            dr.enable_grad(point)
        with private_gradients():
            scatter(self.field, point, slopes)
        if self.source.learns_poses:
            factor = self.field.window(self.field.unit(point), mi.Bool(True))
            there = dr.detach(factor)
            dr.backward_from(factor * dr.select(there > 0, by_window / there, 0))
            by_point = dr.select(self._is_used(samples), dr.grad(point), 0)
            by_origin, by_direction = _along_rays(draw.rays, samples, by_point)
            self.source.backward_rays(draw, by_origin, by_direction)

    def _is_used(self, samples: Samples) -> mi.Bool:
        return dr.arange(mi.UInt32, self.visible) < dr.sum(samples.count)


@dr.syntax
def _encode(field: NGPField, unit: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
    """Encode points (3, n) of a mask; packets without any cost nothing."""
    features = [mi.Float(0) for _ in range(field.encoding.n_output_features)]
    active = mi.Bool(active)
    while active:
        features = [mi.Float(x) for x in field.encoding(unit, active)]
        active = mi.Bool(False)
    return features


def _along_rays(
    rays: Rays, samples: Samples, by_point: mi.Vector3f
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Add derivatives by points (3, m) up to those by rays, (3, n) each."""
    by_origin = dr.zeros(mi.Vector3f, dr.width(rays.direction))
    by_direction = dr.zeros(mi.Vector3f, dr.width(rays.direction))
    dr.make_opaque(by_origin, by_direction)
    for c in range(3):
        add = dr.ReduceOp.Add
        dr.scatter_reduce(add, by_origin[c], by_point[c], samples.ray)
        dr.scatter_reduce(add, by_direction[c], samples.t * by_point[c], samples.ray)
    dr.eval(by_origin, by_direction)
    return by_origin, by_direction


def _points(rays: Rays, samples: Samples) -> mi.Point3f:
    pairs = zip(rays.origin, rays.direction, strict=True)
    return mi.Point3f(
        *(
            dr.gather(mi.Float, o, samples.ray)
            + samples.t * dr.gather(mi.Float, d, samples.ray)
            for o, d in pairs
        )
    )
