"""How many samples rays take, as far as the occupancy tells."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.march import seek
from mi_nerfattack.render.posed import PosedField


@dr.syntax
def sample_count(
    posed: PosedField, origin: Any, direction: Any, t_max: Any, jitter: Any
) -> Any:
    """Count the samples a march would take if nothing stopped it, (n,).

    Args:
        posed: the field and its pose; only its occupancy is looked at.
        origin: (3, n), metres in the world.
        direction: (3, n), unit vectors.
        t_max: (n,), metres.
        jitter: (n,), positions of the samples in their intervals.
    """
    o, d = posed.to_local(origin, direction)
    near, far = posed.interval(o, d, t_max)
    jitter = mi.Float(jitter)
    active = mi.Bool(near < far)
    index = dr.floor(posed.lattice_index(near))  # lattice interval in hand
    count = mi.Float(0)
    while active:
        index, t, width, active = seek(posed, o, d, index, near, far, jitter, active)
        count += dr.select(active, 1.0, 0.0)
        index += 1
    return count
