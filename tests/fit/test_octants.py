"""Octants of cells that a march has to see."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers.small_fields import small_ngp

from mi_nerfattack.fields import Occupancy
from mi_nerfattack.fit.octants import dense_octants

pytestmark = pytest.mark.usefixtures("variant")


def test_dense_octants_against_their_densities_one_by_one(rng):
    field = small_ngp()
    cells = rng.random((4, 3, 2)) < 0.6
    field.occupy(Occupancy(cells))
    fine = np.stack(np.indices((24, 18, 12)), -1).reshape(-1, 3)  # six a cell and axis
    unit = (fine + 0.5) / (24, 18, 12)
    points = field.lower + unit * (field.upper - field.lower)
    density = field.density(mi.Point3f(points.T.copy()), mi.Bool(True)).numpy()
    middle = float(np.median(density[density > 0]))
    blocks = density.reshape(4, 2, 3, 3, 2, 3, 2, 2, 3).max((2, 5, 8))
    bits = (blocks >= middle).transpose(0, 2, 4, 1, 3, 5).reshape(4, 3, 2, 8)
    expected = np.packbits(bits, axis=-1, bitorder="little")[..., 0]
    found = dense_octants(field, 1 - np.exp(-middle * field.step_m))
    differs = np.unpackbits(found ^ expected).sum()
    assert differs <= 1  # the median is one of the densities, but for rounding
    assert 0 < np.unpackbits(found[cells]).mean() < 1 and not found[~cells].any()


def test_no_cell_no_octant():
    field = small_ngp()
    field.occupy(Occupancy(np.zeros((2, 2, 2), bool)))
    assert not dense_octants(field).any()
