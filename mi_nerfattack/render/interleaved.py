"""The exact composite: one march through all fields at once.

Along a ray, the lattice intervals of all fields are merged into segments on which the
set of fields does not change. A segment of width δ at transmittance T, with density
``sigma = sum_k sigma_k`` and emission ``E = sum_k sigma_k L_k`` taken as constant on
it, adds ``T δ phi(sigma δ) E`` to the radiance, ``phi(x) = (1 - exp(-x)) / x``.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.backdrop import Layer, only_fields
from mi_nerfattack.render.batched import march_gradient
from mi_nerfattack.render.composite import (
    AbstractComposite,
    DepthComposite,
    RayTangent,
    Seen,
    Task,
    select,
)
from mi_nerfattack.render.march import March, Rays, absorption, march, private_gradients
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.segments import (
    Cursor,
    Path,
    Segment,
    advance,
    enter,
    next_segment,
)


class InterleavedComposite(AbstractComposite):
    """All fields in one medium: ``sigma = sum sigma_k``, ``L`` their weighted mean.

    Exact also where fields overlap; the steps are those of all fields together.
    Cost: about the sum of the fields' marches, as :class:`DepthComposite`, in one
    loop; its derivative evaluates every field again, also those that ask for no
    gradient. A layer is the field's share of the total, behind whatever hides it, and
    the total is the sum of the shares.
    """

    def check(self, posed: Sequence[Layer]) -> None:
        """See :meth:`AbstractComposite.check`."""
        _fields(posed)

    def render(self, posed: Sequence[Layer], rays: Rays, stop: float) -> Seen:
        """See :meth:`AbstractComposite.render`."""
        lit = rays.light(_fields(posed))
        if len(lit) == 1:  # nothing to merge
            share = march(lit[0], *rays, stop)
            return Seen(share, [share])
        with dr.suspend_grad():
            shares = _march(lit, rays, stop)
        return Seen(_total(shares), shares)

    def keep(self, seen: Seen) -> Any:
        """See :meth:`AbstractComposite.keep`: all, 20 + 20 k bytes a ray."""
        return seen

    def restore(
        self, posed: Sequence[Layer], rays: Rays, kept: Any, stop: float
    ) -> Seen:
        """See :meth:`AbstractComposite.restore`."""
        del posed, rays, stop
        return kept

    def forward(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        seen: Seen,
        stop: float,
        t_rays: RayTangent | None = None,
    ) -> March:
        """See :meth:`AbstractComposite.forward`; not by the rays."""
        fields, mode = _fields(posed), dr.ADMode.Forward
        if t_rays is not None:
            raise TypeError(
                "InterleavedComposite: no forward mode by the rays; use the depth "
                "composite, or keep the camera detached"
            )
        if not any(item.has_gradients for item in fields):
            return March()
        with dr.suspend_grad():
            return _derivative(mode, fields, rays, seen.total, March(), stop, False)[0]

    def tasks(
        self, posed: Sequence[Layer], rays: Rays, seen: Seen, cotangent: March
    ) -> list[Task]:
        """See :meth:`AbstractComposite.tasks`; one, which needs all fields."""
        met = [
            layer.opacity > 0
            for item, layer in zip(posed, seen.layers, strict=True)
            if item.has_gradients
        ]
        if not met:
            return []
        wanted = reduce(operator.or_, met)
        return select(wanted, rays, seen.total, cotangent, tuple(range(len(posed))))

    def accumulate(self, posed: Sequence[Layer], task: Task, stop: float) -> None:
        """See :meth:`AbstractComposite.accumulate`."""
        mode, rays, fields = dr.ADMode.Backward, task.rays, _fields(posed)
        if len(posed) == 1:
            (item,) = rays.light(posed)
            march_gradient(item, rays, task.primal, task.cotangent, stop)
            return
        with dr.suspend_grad(), private_gradients():
            _derivative(mode, fields, rays, task.primal, task.cotangent, stop, False)

    def backward_rays(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        seen: Seen,
        cotangent: March,
        stop: float,
        wanted: Sequence[int],
    ) -> list[RayTangent]:
        """See :meth:`AbstractComposite.backward_rays`; always evaluates all fields."""
        fields, mode = _fields(posed), dr.ADMode.Backward
        with dr.suspend_grad(), private_gradients():
            by_field = _derivative(
                mode, fields, rays, seen.total, cotangent, stop, True
            )[1]
        return [by_field[k] for k in wanted]


COMPOSITES: dict[str, type[AbstractComposite]] = {
    "interleaved": InterleavedComposite,
    "depth": DepthComposite,
}


def _fields(posed: Sequence[Layer]) -> list[PosedField]:
    purpose = "the interleaved composite cannot merge what has no density"
    return only_fields(posed, purpose, "set composite to depth")


def _total(shares: list[March]) -> March:
    return reduce(lambda a, b: a.plus(b, mi.Bool(True)), shares)


@dr.syntax
def _march(posed: list[PosedField], rays: Rays, stop: float) -> list[March]:
    paths, cursors = _enter_all(posed, rays)
    shares = [March() for _ in posed]  # what each field has given so far
    active = mi.Bool(rays.active)
    t = mi.Float(0)  # end of the segments behind, metres
    tau = mi.Float(0)  # optical depth so far
    while active:
        cursors = _advance_all(posed, paths, cursors, t, rays.jitter, active)
        here = next_segment(cursors, t, rays.jitter, active)
        active &= here.end < dr.inf
        values, _ = _evaluate(posed, paths, here, False)
        depth = _density(values) * here.width
        given = dr.exp(-tau) * here.width * absorption(depth)[0]
        shares = _share(shares, values, dr.select(active, given, 0), here.t)
        tau += dr.select(active, depth, 0)
        t = dr.select(active, here.end, t)
        active &= dr.exp(-tau) > stop
    return shares


@dr.syntax
def _derivative(
    mode: dr.ADMode,
    posed: list[PosedField],
    rays: Rays,
    primal: March,
    cotangent: March,
    stop: float,
    with_rays: bool,
) -> tuple[March, list[RayTangent]]:
    posed = rays.light(posed)
    paths, cursors = _enter_all(posed, rays)
    slopes = [_RayGradient() for _ in posed]
    tangent = March()
    active = mi.Bool(rays.active)
    t, tau = mi.Float(0), mi.Float(0)
    rest = primal.copy()  # what is still to come; opacity stays that of the ray
    while active:
        cursors = _advance_all(posed, paths, cursors, t, rays.jitter, active)
        here = next_segment(cursors, t, rays.jitter, active)
        active &= here.end < dr.inf
        with dr.resume_grad():
            values, places = _evaluate(posed, paths, here, with_rays)
            rest, change = _change(values, here, tau, rest)
            if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                dr.backward_from(dr.select(active, cotangent.pair(change), 0))
                slopes = _collect(slopes, places, here.t, active, with_rays)
            else:
                tangent = tangent.plus(dr.forward_to(change), active)
        depth = dr.detach(_density(values)) * here.width
        tau += dr.select(active, depth, 0)
        t = dr.select(active, here.end, t)
        active &= dr.exp(-tau) > stop
    return tangent, _finish(posed, paths, slopes)


def _enter_all(posed: list[PosedField], rays: Rays) -> tuple[list[Path], list[Cursor]]:
    entries = [enter(item, rays) for item in posed]
    return [path for path, _ in entries], [cursor for _, cursor in entries]


def _advance_all(
    posed: list[PosedField],
    paths: list[Path],
    cursors: list[Cursor],
    t: mi.Float,
    jitter: mi.Float,
    active: mi.Bool,
) -> list[Cursor]:
    return [
        advance(item, path, cursor, t, jitter, active)
        for item, path, cursor in zip(posed, paths, cursors, strict=True)
    ]


def _density(values: list) -> mi.Float:
    return sum((density for density, _ in values), mi.Float(0))


def _share(
    shares: list[March], values: list, given: mi.Float, t: mi.Float
) -> list[March]:
    """Add each field's part of a segment to its share."""
    result = []
    for share, (density, colour) in zip(shares, values, strict=True):
        weight = given * density
        result.append(
            March(
                share.radiance + weight * colour,
                share.opacity + weight,
                share.moment + weight * t,
            )
        )
    return result


def _change(
    values: list, here: Segment, tau: mi.Float, rest: March
) -> tuple[March, March]:
    """Linearise the march in one segment.

    Returns:
        what comes behind the segment, and a quantity whose derivative by the values
        of the fields is that of the whole march.
    """
    density = _density(values)
    emission = sum((a * b for a, b in values), mi.Color3f(0))
    sigma, light = dr.detach(density), dr.detach(emission)
    through = dr.exp(-tau)
    behind = dr.exp(-tau - sigma * here.width)
    phi, slope = absorption(sigma * here.width)
    given = through * phi * here.width
    radiance = rest.radiance - light * given
    moment = rest.moment - sigma * given * here.t
    curve = through * here.width * here.width * slope
    change = March(
        given * emission + density * (curve * light - here.width * radiance),
        density * here.width * (1 - rest.opacity),
        density * here.width * (behind * here.t - moment),
    )
    return March(radiance, rest.opacity, moment), change


@dataclass
class _RayGradient:
    """Derivatives by the ray in the frame of one field, so far."""

    origin: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    direction: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    heading: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))


def _evaluate(
    posed: list[PosedField], paths: list[Path], here: Segment, with_rays: bool
) -> tuple[list, list]:
    """Evaluate all fields, attached; also return the points and directions used."""
    values, places = [], []
    for item, path, inside in zip(posed, paths, here.inside, strict=True):
        point = mi.Point3f(path.o + here.t * path.d)
        heading = mi.Vector3f(path.heading)
        if with_rays:
            dr.enable_grad(point, heading)
        values.append(item.eval(point, heading, inside))
        places.append((point, heading))
    return values, places


def _collect(
    slopes: list[_RayGradient],
    places: list,
    t: mi.Float,
    active: mi.Bool,
    with_rays: bool,
) -> list[_RayGradient]:
    if not with_rays:
        return slopes
    result = []
    for slope, (point, heading) in zip(slopes, places, strict=True):
        by_point = dr.select(active, mi.Vector3f(dr.grad(point)), 0)
        by_heading = dr.select(active, dr.grad(heading), 0)
        result.append(
            _RayGradient(
                slope.origin + by_point,
                slope.direction + t * by_point,
                slope.heading + by_heading,
            )
        )
    return result


def _finish(
    posed: list[PosedField], paths: list[Path], slopes: list[_RayGradient]
) -> list[RayTangent]:
    """Return each field's derivatives by origin and direction in the world."""
    result = []
    for item, path, slope in zip(posed, paths, slopes, strict=True):
        along = path.heading * dr.dot(path.heading, slope.heading)
        turned = (slope.heading - along) * dr.rcp(dr.norm(path.d))
        result.append(item.to_world_gradient(slope.origin, slope.direction + turned))
    return result
