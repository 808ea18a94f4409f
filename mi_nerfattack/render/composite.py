"""Composite of several fields along a ray (A.4 to A.6)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.march import March


def depth_composite(layers: list[March]) -> March:
    """Fold fields front to back in the order of their expected depth.

    Per ray and fold, ``I = I_f + (1 - a_f) I_b`` and ``a = a_f + (1 - a_f) a_b``
    with premultiplied radiance I; this is A.6 with ``c = I / a``, times the opacity
    that A.6 divides by. Fields of equal depth keep the order of the list.
    Differentiable except in the order itself.

    Args:
        layers: one march a field, each of n rays; at least one.

    Returns:
        the composite; its depth is the expected depth of all that is seen.

    Source: appendix A.4 to A.6.
    """
    ordered = sort_by_depth(layers)
    result = ordered[-1]
    for front in reversed(ordered[:-1]):
        result = over(front, result)
    return result


def over(front: March, back: March) -> March:
    """Lay one march over another; all that passes the front meets the back."""
    passed = 1 - front.opacity
    return March(
        front.radiance + passed * back.radiance,
        front.opacity + passed * back.opacity,
        front.moment + passed * back.moment,
    )


def sort_by_depth(layers: list[March]) -> list[March]:
    """Sort marches per ray by expected depth, nearest first, with stable selections.

    An odd-even transposition network: (k^2 - k) / 2 selections for k layers.
    """
    ordered = list(layers)
    depths = [dr.detach(layer.depth) for layer in ordered]
    for end in range(len(ordered) - 1, 0, -1):
        for i in range(end):
            swap = depths[i + 1] < depths[i]
            a, b = ordered[i], ordered[i + 1]
            ordered[i], ordered[i + 1] = _select(swap, b, a), _select(swap, a, b)
            da, db = depths[i], depths[i + 1]
            depths[i], depths[i + 1] = dr.minimum(da, db), dr.maximum(da, db)
    return ordered


def _select(mask: mi.Bool, a: March, b: March) -> March:
    return March(
        dr.select(mask, a.radiance, b.radiance),
        dr.select(mask, a.opacity, b.opacity),
        dr.select(mask, a.moment, b.moment),
    )
