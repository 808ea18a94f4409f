"""Lists of splats laid over each other along rays, and the derivatives of that."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.rays import March, Rays, pick_rays
from mi_nerfattack.render.splatting.charts import Sorted
from mi_nerfattack.render.splatting.pairs import REACH, Lists, gather_rows, turn

MAX_OPACITY = 0.9999
WINDOW = 16  # hits of a ray that wait for one that is nearer
_ROUNDING = 1e-5  # of an sRGB value that was decoded and encoded again


@dataclass
class _Hit:
    """A splat on a ray.

    Attributes:
        peak: (n,), metres along the ray.
        opacity: (n,), there; 0 for none.
        index: (n,), among the splats of the lists.
    """

    peak: mi.Float
    opacity: mi.Float
    index: mi.UInt32


@dataclass
class Lines:
    """Rays in the order of their cells, from the origins of their charts.

    Attributes:
        origin: (3, n), from the chart's.
        direction: (3, n).
        t_max: (n,).
        active: (n,).
        begin, end: (n,), of their lists.
    """

    origin: mi.Vector3f
    direction: mi.Vector3f
    t_max: mi.Float
    active: mi.Bool
    begin: mi.UInt32
    end: mi.UInt32


def by_cell(rays: Rays, where: Sorted, lists: Lists) -> Lines:
    """Return rays in the order of `where.order`, with their lists."""
    rays = pick_rays(rays, where.order)
    cell = dr.gather(mi.UInt32, where.cell, where.order)
    chart = dr.gather(mi.UInt32, where.chart, where.order)
    start = dr.gather(mi.Point3f, where.charts.origin, chart)
    origin, direction = mi.Vector3f(rays.origin - start), mi.Vector3f(rays.direction)
    begin = dr.gather(mi.UInt32, lists.start, cell)
    end = begin + dr.gather(mi.UInt32, lists.length, cell)
    active = rays.active & (end > begin) & (rays.t_max > 0)
    return Lines(
        origin,
        direction,
        t_max=mi.Float(rays.t_max),
        active=active,
        begin=begin,
        end=end,
    )


@dr.syntax
def blend(rays: Lines, lists: Lists, shades: mi.Float, stop: float) -> March:
    """Lay the splats of each ray over each other."""
    window, place, active = _start(rays)
    display = mi.Color3f(0)  # premultiplied sRGB so far
    moment = mi.Float(0)
    passed = mi.Float(1)  # transmittance so far
    while active:
        window, hit, is_hit = _next(
            rays, lists, shades, window=window, place=place, active=active
        )
        shade = dr.gather(mi.Vector4f, shades, hit.index, is_hit)
        weight = passed * hit.opacity
        display += weight * mi.Color3f(shade.xyz)
        moment += dr.select(is_hit, weight * hit.peak, 0)
        passed -= weight
        place += 1
        active &= (place < rays.end + WINDOW) & (passed > stop)
    return _develop(March(display, 1 - passed, moment))


@dr.syntax
def replay(
    mode: dr.ADMode,
    rays: Lines,
    lists: Lists,
    shades: mi.Float,
    primal: March,
    cotangent: March,
    stop: float,
    with_rays: bool,
) -> tuple[March, list[mi.Vector3f]]:
    """Replay :func:`blend`, and propagate derivatives by shades and by rays.

    With ``w_i`` the weight and ``T_i`` the transmittance before splat i:
    ``dI/dc_i = w_i``, ``dI/da_i = T_i c_i - sum_{j>i} w_j c_j / (1 - a_i)``. Opacity
    and moment have the same form.

    Returns:
        the tangent of the march, and the derivatives by origin and direction.
    """
    # From the developed march to the sums of the loop
    sums, by_sums = _sums_of(primal, cotangent)
    # The sums behind the splat that is at hand
    display, moment = mi.Color3f(sums.radiance), mi.Float(sums.moment)
    passed, left = mi.Float(1), 1 - primal.opacity
    window, place, active = _start(rays)
    tangent, by_origin, by_direction = March(), mi.Vector3f(0), mi.Vector3f(0)
    while active:
        window, hit, is_hit = _next(
            rays, lists, shades, window=window, place=place, active=active
        )
        with dr.resume_grad():
            # The splat again, attached to its shade and to the ray
            origin, direction = mi.Vector3f(rays.origin), mi.Vector3f(rays.direction)
            if dr.hint(with_rays, mode="scalar"):
                dr.enable_grad(origin, direction)
            shade = dr.gather(mi.Vector4f, shades, hit.index, is_hit)
            peak, opacity, _ = _meet(
                origin, direction, lists, shade=shade, index=hit.index, active=is_hit
            )
            # dI/dc = w, dI/da = T c less what is behind
            colour = mi.Color3f(shade.xyz)
            weight, depth = passed * hit.opacity, dr.select(is_hit, hit.peak, 0)
            display -= weight * dr.detach(colour)
            moment -= weight * depth
            behind = dr.rcp(1 - hit.opacity)
            by_colour = passed * dr.detach(colour) - display * behind
            by_peak = passed * depth - moment * behind
            change = March(
                weight * colour + by_colour * opacity,
                left * behind * opacity,
                weight * peak + by_peak * opacity,
            )
            # From the splat to the parameters and the ray, or the other way
            if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                dr.backward_from(dr.select(is_hit, by_sums.pair(change), 0))
            else:
                tangent = tangent.plus(dr.forward_to(change), is_hit)
            if dr.hint(with_rays, mode="scalar"):
                by_origin += dr.select(is_hit, dr.grad(origin), 0)
                by_direction += dr.select(is_hit, dr.grad(direction), 0)
        passed -= weight
        place += 1
        active &= (place < rays.end + WINDOW) & (passed > stop)
    return _tangent_of(sums, tangent), [by_origin, by_direction]


def _start(rays: Lines) -> tuple[list[_Hit], mi.UInt32, mi.Bool]:
    window = [_Hit(mi.Float(-dr.inf), mi.Float(0), mi.UInt32(0)) for _ in range(WINDOW)]
    return window, mi.UInt32(rays.begin), mi.Bool(rays.active)


def _next(
    rays: Lines,
    lists: Lists,
    shades: mi.Float,
    window: list[_Hit],
    place: mi.UInt32,
    active: mi.Bool,
) -> tuple[list[_Hit], _Hit, mi.Bool]:
    """Put the next splat of the lists into the window.

    After the end of a list, as many turns empty the window.

    Returns:
        the window, the nearest hit, which left it, and whether it is one.
    """
    inside = active & (place < rays.end)
    index = dr.gather(mi.UInt32, lists.index, place, inside)
    shade = dr.gather(mi.Vector4f, shades, index, inside)
    peak, opacity, squared = _meet(
        rays.origin, rays.direction, lists, shade=shade, index=index, active=inside
    )
    met = inside & (squared <= REACH**2) & (peak > 0) & (peak < rays.t_max)
    none = dr.select(place < rays.end, mi.Float(-dr.inf), mi.Float(dr.inf))
    new = _Hit(dr.select(met, peak, none), dr.select(met, opacity, 0), index)
    window, hit = _slide(window, new)
    return window, hit, active & (hit.opacity > 0)


def _meet(
    origin: mi.Vector3f,
    direction: mi.Vector3f,
    lists: Lists,
    shade: mi.Vector4f,
    index: mi.UInt32,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return peak, opacity and squared distance of splats on rays."""
    rows, start = gather_rows(lists.near.records, index, active)
    o, d = start + turn(rows, origin), turn(rows, direction)
    inverse = dr.rcp(dr.select(active, dr.squared_norm(d), 1))
    # well-conditioned where the splat is thin, unlike |o + t d|
    squared = dr.squared_norm(dr.cross(o, d)) * inverse
    opacity = dr.minimum(shade.w * dr.exp(-0.5 * squared), MAX_OPACITY)
    return -dr.dot(o, d) * inverse, opacity, squared


def _slide(window: list[_Hit], new: _Hit) -> tuple[list[_Hit], _Hit]:
    """Put a hit into a window, sorted by peak; return it and its nearest, which left.

    What is no hit leaves at once, at minus infinity, or comes last, at infinity.
    """
    after = [*window[1:], _Hit(mi.Float(dr.inf), mi.Float(0), mi.UInt32(0))]
    nearest = dr.select(new.peak <= window[0].peak, new, window[0])
    moved = [
        dr.select(
            new.peak > farther.peak, farther, dr.select(new.peak > hit.peak, new, hit)
        )
        for hit, farther in zip(window, after, strict=True)
    ]
    return moved, nearest


def _develop(sums: March) -> March:
    """Return the march of sums whose radiance is premultiplied sRGB.

    A channel above 1 is cut off there, so the channel is a constant of derivatives.
    """
    visible = sums.opacity > 0
    ratio = sums.radiance / dr.select(visible, sums.opacity, 1)
    # `_sums_of` finds a channel that was cut off at 1, except for rounding
    ratio = dr.select(ratio < 1 - _ROUNDING, ratio, dr.detach(ratio))
    colour = dr.srgb_to_linear(ratio)
    return March(sums.opacity * colour, sums.opacity, sums.moment)


def _sums_of(primal: March, cotangent: March) -> tuple[March, March]:
    """Undo :func:`_develop`, for a march and for its cotangent."""
    visible = primal.opacity > 0
    colour = primal.radiance / dr.select(visible, primal.opacity, 1)
    display = primal.opacity * dr.linear_to_srgb(colour)
    sums = March(display, mi.Float(primal.opacity), mi.Float(primal.moment))
    with dr.resume_grad():
        leaf = sums.copy()
        dr.enable_grad(leaf)
        flags = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad  # of no cotangent
        dr.backward_from(_develop(leaf).pair(cotangent), flags=flags)
        by_sums = dr.grad(leaf)
    return sums, by_sums


def _tangent_of(sums: March, tangent: March) -> March:
    """Return the tangent of :func:`_develop`, from that of the sums."""
    with dr.resume_grad():
        leaf = sums.copy()
        dr.enable_grad(leaf)
        dr.set_grad(leaf, tangent)
        flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
        return dr.forward_to(_develop(leaf), flags=flags)
