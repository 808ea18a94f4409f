"""Samples of a batch of rays, listed ray by ray, and sums along the rays.

The positions of samples depend on the occupancy alone. Listed, a field can be
evaluated at all of them in one wide launch, however long each ray is.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.sums import Sums, sample_weight
from mi_nerfattack.render.walk import Walk, sample_count


@dataclass
class Samples:
    """Samples of n rays in m slots; what a slot beyond the last sample holds is void.

    Attributes:
        first: (n,), slot of a ray's first sample.
        count: (n,), samples of a ray; 0 where they did not fit.
        fits: (n,), whether a ray has all its samples.
        ray: (m,), the ray of a slot.
        t: (m,), position on the ray, metres.
        width: (m,), length of the interval that the sample represents, metres, times
            the field's window there.
    """

    first: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    count: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    fits: mi.Bool = field(default_factory=lambda: mi.Bool(True))
    ray: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    t: mi.Float = field(default_factory=lambda: mi.Float(0))
    width: mi.Float = field(default_factory=lambda: mi.Float(0))


def list_samples(posed: PosedField, rays: Rays, capacity: int) -> Samples:
    """List the samples that a march would take if no ray ended early.

    Args:
        posed: the field; only its occupancy is looked at.
        rays: n rays.
        capacity: number of slots; from the ray whose samples do not fit, rays stay
            empty.
    """
    count = mi.UInt32(sample_count(posed, rays))
    first, fits = _places(count, capacity)
    samples = Samples(
        first=first,
        count=dr.select(fits, count, 0),
        fits=fits & rays.active,
        ray=dr.zeros(mi.UInt32, capacity),
        t=dr.zeros(mi.Float, capacity),
        width=dr.zeros(mi.Float, capacity),
    )
    dr.make_opaque(samples)
    _fill(posed, rays, samples)
    dr.eval(samples)
    return samples


def keep_visible(
    samples: Samples, depths: mi.Float, stop: float, capacity: int
) -> tuple[Samples, mi.UInt32]:
    """Keep the samples that light reaches the eye from.

    Args:
        samples: n rays, m slots.
        depths: (m,), optical depth of each sample's interval.
        stop: transmittance before which a ray ends.
        capacity: slots of the result.

    Returns:
        The samples kept, and their slots in `samples` (capacity,).
    """
    count = _visible(samples, depths, stop)
    first, fits = _places(count, capacity)
    count = dr.select(fits, count, 0)
    slots = dr.zeros(mi.UInt32, capacity)
    dr.make_opaque(slots, count, first)
    _list_slots(samples.first, first, count, slots)
    dr.eval(slots)
    return Samples(
        first=first,
        count=count,
        fits=samples.fits & fits,
        ray=dr.gather(mi.UInt32, samples.ray, slots),
        t=dr.gather(mi.Float, samples.t, slots),
        width=dr.gather(mi.Float, samples.width, slots),
    ), slots


def _places(count: mi.UInt32, capacity: int) -> tuple[mi.UInt32, mi.Bool]:
    first = dr.block_prefix_sum(count, dr.width(count), exclusive=True)
    return first, first + count <= capacity


@dr.syntax
def _fill(posed: PosedField, rays: Rays, samples: Samples) -> None:
    slot, end = mi.UInt32(samples.first), samples.first + samples.count
    ray = dr.arange(mi.UInt32, dr.width(samples.first))
    walk = Walk.start(posed, rays)[0]
    active = slot < end
    while active:
        walk, segment = walk.next([posed], active)
        dr.scatter(samples.ray, ray, slot, segment.active)
        dr.scatter(samples.t, segment.t, slot, segment.active)
        unit = posed.field.unit(walk.paths[0].at(segment.t))
        width = segment.width * posed.field.window(unit, segment.active)
        dr.scatter(samples.width, width, slot, segment.active)
        slot += 1
        active = segment.active & (slot < end)


@dr.syntax
def _visible(samples: Samples, depths: mi.Float, stop: float) -> mi.UInt32:
    slot, end = mi.UInt32(samples.first), samples.first + samples.count
    tau, count = mi.Float(0), mi.UInt32(0)
    active = slot < end
    while active:
        tau += dr.gather(mi.Float, depths, slot, active)
        count += 1
        slot += 1
        active &= (slot < end) & (dr.exp(-tau) > stop)
    return count


@dr.syntax
def _list_slots(
    source: mi.UInt32, first: mi.UInt32, count: mi.UInt32, slots: mi.UInt32
) -> None:
    k = mi.UInt32(0)
    while k < count:
        dr.scatter(slots, source + k, first + k)
        k += 1


@dr.syntax
def composite(samples: Samples, depths: mi.Float, colour: Any) -> March:
    """Add up the light of samples along each ray; as `render.march.march`.

    Args:
        samples: n rays, m slots.
        depths: (m,), optical depth of each interval.
        colour: (3, m), radiance of each.
    """
    slot, end = mi.UInt32(samples.first), samples.first + samples.count
    sums = Sums.zeros(1)
    active = slot < end
    while active:
        x = dr.gather(mi.Float, depths, slot, active)
        t = dr.gather(mi.Float, samples.t, slot, active)
        sums = sums.plus([x], [_pick(colour, slot, active)], t)
        slot += 1
        active &= slot < end
    return sums.march()


def _pick(colour: mi.Color3f, slot: mi.UInt32, active: mi.Bool) -> mi.Color3f:
    return mi.Color3f(*(dr.gather(mi.Float, c, slot, active) for c in colour))


@dataclass
class Spread:
    """How far apart the weights of a ray are.

    The penalty is ``sum_jk w_j w_k |s_j - s_k| + sum_k w_k^2 width / 3``.

    Attributes:
        factor: (n,), of the penalty in the objective.
        position: (m,), s of the samples.
        width: of an interval, in the same unit; one entry.
        weight: (n,), sum of w_k.
        moment: (n,), sum of w_k s_k.
        penalty: (n,).

    Source: Barron et al. 2022, eq. 15.
    """

    factor: mi.Float = field(default_factory=lambda: mi.Float(0))
    position: mi.Float = field(default_factory=lambda: mi.Float(0))
    width: mi.Float = field(default_factory=lambda: mi.Float(0))
    weight: mi.Float = field(default_factory=lambda: mi.Float(0))
    moment: mi.Float = field(default_factory=lambda: mi.Float(0))
    penalty: mi.Float = field(default_factory=lambda: mi.Float(0))

    def slope(
        self, weight: mi.Float, position: mi.Float, before: mi.Float, moment: mi.Float
    ) -> mi.Float:
        """Return the penalty's derivative by a weight.

        Args:
            weight: of the sample.
            position: of the sample.
            before: sum of the weights before it.
            moment: sum of weight times position before it.
        """
        behind = self.weight - before - weight
        moment_behind = self.moment - moment - weight * position
        distance = position * (before - behind) - (moment - moment_behind)
        return 2 * distance + (2 / 3) * weight * self.width


@dr.syntax
def measure_spread(
    samples: Samples, depths: mi.Float, position: mi.Float, width: mi.Float, factor: Any
) -> Spread:
    """Measure the spread of weights along each ray.

    Args:
        samples: n rays, m slots.
        depths: (m,), optical depth of each interval.
        position: (m,), of the samples, in whatever unit the spread is to have.
        width: of an interval, in the same unit; one entry.
        factor: (n,), of the penalty in the objective.
    """
    slot, end = mi.UInt32(samples.first), samples.first + samples.count
    tau, before, moment, penalty = (mi.Float(0) for _ in range(4))
    active = slot < end
    while active:
        x = dr.gather(mi.Float, depths, slot, active)
        s = dr.gather(mi.Float, position, slot, active)
        weight = sample_weight(tau, x)
        # each pair is met once, at its farther sample
        penalty += weight * (2 * (s * before - moment) + weight * width / 3)
        before += weight
        moment += weight * s
        tau += x
        slot += 1
        active &= slot < end
    return Spread(
        factor=factor,
        position=position,
        width=width,
        weight=before,
        moment=moment,
        penalty=penalty,
    )


@dr.syntax
def cotangents(
    samples: Samples,
    depths: mi.Float,
    colour: Any,
    primal: March,
    cotangent: March,
    spread: Spread,
) -> tuple[mi.Float, mi.Color3f]:
    """Differentiate an objective by what a composite was made of.

    With ``w_k`` the weight of a sample, ``T_k+1`` the transmittance behind it and
    ``g_k`` the objective's derivative by the weight:
    ``dJ/dx_k = T_k+1 g_k - sum_{j>k} w_j g_j``. This computes :class:`Remainder` with
    one sum, of ``w_j g_j``, instead of one sum for each part of a march.

    Args:
        samples: n rays, m slots.
        depths: (m,), optical depth of each interval.
        colour: (3, m), radiance of each.
        primal: what :func:`composite` returned.
        cotangent: derivative of the objective by `primal`.
        spread: from :func:`measure_spread`.

    Returns:
        the derivatives by `depths` (m,) and by `colour` (3, m), zero in void slots.
    """
    count = dr.width(depths)
    by_depth = dr.zeros(mi.Float, count)
    by_colour = dr.zeros(mi.Color3f, count)
    dr.make_opaque(by_depth, by_colour)
    # sum of w_j g_j still to come; the penalty is of second degree in the weights
    sum_behind = cotangent.pair(primal) + 2 * spread.factor * spread.penalty
    before, moment = mi.Float(0), mi.Float(0)
    slot, end = mi.UInt32(samples.first), samples.first + samples.count
    tau = mi.Float(0)
    active = slot < end
    while active:
        x = dr.gather(mi.Float, depths, slot, active)
        s = dr.gather(mi.Float, spread.position, slot, active)
        value = _pick(colour, slot, active)
        weight = sample_weight(tau, x)
        g = (
            dr.dot(cotangent.radiance, value)
            + cotangent.opacity
            + cotangent.moment * dr.gather(mi.Float, samples.t, slot, active)
            + spread.factor * spread.slope(weight, s, before, moment=moment)
        )
        before += weight
        moment += weight * s
        sum_behind -= weight * g
        dr.scatter(by_depth, dr.exp(-tau - x) * g - sum_behind, slot, active)
        for c in dr.hint(range(3), mode="scalar"):
            dr.scatter(by_colour[c], weight * cotangent.radiance[c], slot, active)
        tau += x
        slot += 1
        active &= slot < end
    return by_depth, by_colour
