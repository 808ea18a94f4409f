"""How splats lie in memory, and how rays are put into cells: what marches cost."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.render.splatting.background import _near_each_other
from mi_nerfattack.render.splatting.charts import PER_CELL, sort_rays


def test_splats_of_an_octant_lie_together(rng) -> None:
    lattice = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)
    points = rng.permutation(lattice) + [7, -3, 2]
    cubes = points[_near_each_other(points)].reshape(8, 8, 3)
    np.testing.assert_array_equal(np.ptp(cubes, axis=1), np.ones((8, 3)))


@pytest.mark.usefixtures("variant")
def test_cells_hold_few_rays_whatever_the_shape_of_the_picture() -> None:
    y, z = np.meshgrid(np.linspace(-0.4, 0.4, 400), np.linspace(-0.1, 0.1, 100))
    rays = np.stack([0 * y + 1, y, z]).reshape(3, -1)
    rays /= np.linalg.norm(rays, axis=0)
    sorted_rays = sort_rays(mi.Point3f(0), mi.Vector3f(rays.astype(np.float32)))
    assert rays.shape[1] / sorted_rays.cells == pytest.approx(PER_CELL, rel=0.1)
