"""One step of a fit of any field, by marching and replaying the march."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fit.batch import STOP, BatchSource, Draw, Score
from mi_nerfattack.render.march import march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays, pick_rays
from mi_nerfattack.render.walk import sample_count


class MarchStep:
    """Gradients of a field by a batch of rays; one kernel for each pass.

    Args:
        field: the field, at the identity pose.
        source: of rays, and of the loss.
    """

    def __init__(self, field: AbstractField, source: BatchSource) -> None:
        self.field, self.source = field, source
        self.posed = PosedField(field)

    def __call__(self, random: Any, limit: mi.UInt32) -> tuple[Score, Any]:
        """Accumulate gradients of the parameters that ask for them.

        Args:
            random: `mi.PCG32`, one stream a ray.
            limit: number of rays in use.

        Returns:
            the score, and the advanced random numbers.
        """
        draw = self.source.draw(random, limit)
        rays = draw.rays
        count = mi.UInt32(sample_count(self.posed, rays))
        # rays of a packet take as long as the longest of them
        order = mi.UInt32(dr.argsort(count))
        sorted_rays = pick_rays(rays, order)
        with dr.suspend_grad():
            sorted_primal = march(self.posed, sorted_rays, STOP)
            primal = _put_back(sorted_primal, order)
        dr.eval(primal, random)
        score, cotangent = self.source.compare(draw, primal, rays.active)
        self._backward(
            draw, sorted_rays, sorted_primal, pick_rays(cotangent, order), order
        )
        score.listed = score.visible = dr.sum(count)
        return score, random

    def _backward(
        self, draw: Draw, rays: Rays, primal: March, cotangent: March, order: mi.UInt32
    ) -> None:
        # rays of a packet rarely meet in a vertex: adding them up first is no gain
        with dr.scoped_set_flag(dr.JitFlag.ScatterReduceLocal, False):
            _, by_rays = march_derivative(
                dr.ADMode.Backward,
                self.posed,
                rays,
                primal=primal,
                cotangent=cotangent,
                stop=STOP,
                with_rays=self.source.learns_poses,
            )
        if self.source.learns_poses:
            self.source.backward_rays(
                draw,
                _put_back(by_rays.origin, order),
                _put_back(by_rays.direction, order),
            )


def _put_back(value: Any, order: mi.UInt32) -> Any:
    """Undo `pick_rays(..., order)`."""
    rank = dr.zeros(mi.UInt32, dr.width(order))
    dr.scatter(rank, dr.arange(mi.UInt32, dr.width(order)), order)
    return pick_rays(value, rank)
