"""Random numbers of a ray, by the number of its drive and its pixel."""

from __future__ import annotations

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi


def keyed_sampler(
    seed: mi.UInt32, step: mi.UInt32, first: int, count: int
) -> mi.Sampler:
    """Make a sampler of independent numbers for an integrator.

    Args:
        seed: of all.
        step: index of the control period.
        first: number of the first ray among those of all drives.
        count: of rays.
    """
    ray = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    state, stream = mi.sample_tea_32(mi.sample_tea_32(step, seed)[0], ray)
    # with arguments, the constructor would add the index of the ray
    random = mi.PCG32()  # pyright: ignore[reportCallIssue]
    random.seed(mi.UInt64(state), mi.UInt64(stream))
    return _type(mi.variant())(random)


@cache
def _type(variant: str | None) -> Any:
    del variant  # Mitsuba's class follows from it

    class KeyedSampler(mi.Sampler):
        """Numbers of `mi.PCG32`, as those of Mitsuba's `independent`."""

        def __init__(self, random: Any) -> None:
            super().__init__(mi.Properties("independent"))
            self.random = random

        def clone(self) -> KeyedSampler:
            return KeyedSampler(mi.PCG32(self.random))  # pyright: ignore

        def next_1d(self, active: Any = True) -> mi.Float:
            return self.random.next_float32(mi.Bool(active))

        def next_2d(self, active: Any = True) -> mi.Point2f:
            x = self.next_1d(active)
            return mi.Point2f(x, self.next_1d(active))

        def schedule_state(self) -> None:
            dr.schedule(self.random)

        def wavefront_size(self) -> int:
            return dr.width(self.random)

    return KeyedSampler
