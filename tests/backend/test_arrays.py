"""Arrays end to end, and apart again."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.kernels import nothing_compiled

from mi_nerfattack.backend.arrays import concat, split
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")


def _rays(rng: np.random.Generator, count: int) -> Rays:
    origin = mi.Point3f(*[mi.Float(rng.random(count).tolist()) for _ in range(3)])
    gains = [mi.Color3f(mi.Float(rng.random(count).tolist()))]
    rays = Rays(origin, mi.Vector3f(origin), gains=gains)
    rays.jitter, rays.t_max = dr.opaque(mi.Float, 0.5), dr.opaque(mi.Float, dr.inf)
    rays.active = dr.opaque(mi.Bool, True)
    dr.eval(rays)
    return rays


def test_dataclasses_are_laid_leaf_by_leaf_and_single_entries_spread(rng):
    counts = [5, 1, 7]
    parts = [_rays(rng, count) for count in counts]
    parts[2].jitter = dr.opaque(mi.Float, 0.25)
    found = concat(parts, counts)
    expected = np.concatenate([part.origin.numpy() for part in parts], axis=1)
    assert (found.origin.numpy() == expected).all()
    assert found.gains[0].numpy().shape == (3, 13)
    assert found.jitter.numpy().tolist() == [0.5] * 6 + [0.25] * 7
    assert np.isinf(found.t_max.numpy()).sum() == 13
    assert found.active.numpy().tolist() == [True] * 13


def test_kernels_do_not_depend_on_sizes_and_numbers_of_parts(rng):
    concat([_rays(rng, 5), _rays(rng, 7)], [5, 7])
    split(dr.arange(mi.Float, 8) + 0.5, 4)
    dr.eval(rows := dr.arange(mi.Float, 12) + 0.5)
    for counts in ((6, 6, 6), (4, 9), (3, 3, 3, 3), (8,)):
        parts = [_rays(rng, count) for count in counts]
        with nothing_compiled():
            concat(parts, counts)
    with nothing_compiled():
        parts = split(rows, 3)
    assert [part.numpy().tolist() for part in parts[:2]] == [
        [0.5, 1.5, 2.5],
        [3.5, 4.5, 5.5],
    ]
