"""What an attack reaches wherever an object may stand: 24 drawn places.

Settled before the first result: eight places on each route, drawn by the rule of
training (`bench.study.places`), seeds 1 to 8; the hydrant at its natural height and at
twice; the default attack with the iterations below; drives to the end of the route. The
first draw of each seed counts, and every row is kept, also where the checks before an
attack find that it would prove nothing (`flags`). An attack *succeeds* at a place if it
has a wheel out for a second on average over the drives of the case.
"""

from __future__ import annotations

import itertools

from bench.study import jobs, rows
from bench.study.places import NATURAL_M, ROUTES, Place

SEEDS = tuple(range(1, 9))
HEIGHTS_M = (NATURAL_M, 2 * NATURAL_M)
#: Training's distances from the lane centre, and all of a route but its ends, metres.
LATERAL_M, ARC_M = (2.0, 5.0), (8.0, 36.0)
SUCCESS_S = 1.0
KEYS = """
[drive]
runs = 4

[attack]
max_iterations = 24
adjoint = "kept_backgrounds"

[baseline]
textures = 12
deployment_textures = 6

[deployment]
spp = 8
"""


def keys() -> list[rows.Row]:
    """Return what tells one row from another, one place after the other."""
    cells = itertools.product(SEEDS, ROUTES, HEIGHTS_M)
    return [{"route": r, "seed": s, "height_m": h} for s, r, h in cells]


def attack_row(key: rows.Key) -> rows.Row:
    """Attack at one place."""
    place = Place(key["route"], LATERAL_M, ARC_M, key["seed"])
    return jobs.run(lambda folder: place.write(key["height_m"], KEYS, folder))
