"""Octants of cells that a march has to see, and cells that show in images."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers.small_fields import ONES, small_ngp, vertices

from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.fields import GridField, GridLayout, Occupancy
from mi_nerfattack.fit.pruning import dense_octants, seen_matter
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

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


def test_cells_show_in_front_of_the_first_surface_alone():
    """Walls that end at x = 0.2 and -0.4, and haze before the first, seen from +x."""
    field = GridField(GridLayout(1, 21, 21), -ONES, ONES, step_m=0.02)
    x = vertices(field)[:, 0]
    wall = np.any([np.abs(x - 0.15) < 0.09, np.abs(x + 0.45) < 0.09], axis=0)
    haze = np.abs(x - 0.65) < 0.09
    raw = np.select([wall, haze], [np.log(200.0), np.log(0.5)], -30.0)
    field.set_parameter("density", raw.astype(np.float32))
    full = np.ones((20, 20, 20), bool)
    full[12, :, :10] = False  # from 0.2 to 0.3, where density falls
    field.occupy(Occupancy(full))
    pose = look_at(np.array([2.5, 0, 0]), np.zeros(3))[None]
    pixels, lens = np.zeros((1, 64, 64, 4), np.uint8), from_fov(64, 64, 30)
    images = PosedImages(pixels, pose, lens, ("a",))
    shown = seen_matter(field, images, [0], min_weight=0.05)
    assert not shown[~full].any() and shown[12, 6:14, 10:14].all()
    assert not shown[13:].any() and not shown[:11].any()
    more = seen_matter(field, images, [0], min_weight=1e-3)
    assert more[16, 6:14, 6:14].any() and not more[:10, 6:14, 11:14].any()
