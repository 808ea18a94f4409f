"""Splats in memory, rays in charts and cells, and colours that are cut off at 1."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.files import objects as made

from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.splatting.background import SplatBackground, _near_each_other
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


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("near_clip", [1e-6, 1e-2])
def test_a_camera_sees_the_same_whatever_else_is_in_the_batch(rng, near_clip) -> None:
    """Colours change with the view, and rays start on the near clip."""
    places, bands = rng.uniform([3, -4, -2], [9, 4, 2], (50, 3)), (50, 3, 3)
    shades = rng.random((50, 3)), 0.5, 0.4, (1, 0, 0, 0), rng.normal(0, 0.3, bands)
    splats = SplatBackground(made.splats(places, *shades))
    y, z = np.meshgrid(np.linspace(-0.6, 0.6, 16), np.linspace(-0.4, 0.4, 10))
    aims = np.stack([0 * y + 1, y, z]).reshape(3, -1)
    aims /= np.linalg.norm(aims, axis=0)

    def see(*eyes: tuple[float, float, float]) -> np.ndarray:
        origins = [np.array(eye)[:, None] + near_clip * aims for eye in eyes]
        start = np.concatenate(origins, 1).astype(np.float32)
        towards = np.tile(aims, len(eyes)).astype(np.float32)
        rays = Rays(mi.Point3f(start), mi.Vector3f(towards))
        return splats.march(rays, 0.0).radiance.numpy()

    alone, both = see((0, 0, 0)), see((0, 0, 0), (1, 2, 0))
    assert alone.mean() > 0.1
    np.testing.assert_allclose(both[:, : aims.shape[1]], alone, atol=1e-5)


@pytest.mark.usefixtures("variant")
def test_what_is_overexposed_has_the_derivative_of_its_opacity() -> None:
    """White times ``a = 1 - (1 - a_0) (1 - a_1)``, since the colour is cut off at 1."""
    opacities = np.array([0.95, 0.9])
    item = made.splats([[2, 0, 0], [4, 0, 0]], [[1.4] * 3, [0.3] * 3], opacities)
    splats, rays = SplatBackground(item), Rays(direction=mi.Vector3f(1, 0, 0))
    primal = splats.march(rays, 0.0)
    np.testing.assert_allclose(primal.radiance.numpy()[:, 0], 0.995, rtol=1e-5)
    dr.enable_grad(splats.opacity, splats.harmonics)
    cotangent = March(mi.Color3f(1))
    splats.derivative(dr.ADMode.Backward, rays, primal, cotangent, stop=0.0)
    expected = 3 * (1 - opacities[::-1])
    np.testing.assert_allclose(dr.grad(splats.opacity).numpy(), expected, rtol=1e-4)
    assert not dr.grad(splats.harmonics).numpy().any()
