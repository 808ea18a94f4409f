"""Emptiness as part of a field, the same for whatever evaluates it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.fields import window
from support.worlds.fields import ONES, homogeneous, small_ngp

from mi_nerfattack.fields import Occupancy
from mi_nerfattack.fields.cpu.ngp import PackedNGP
from mi_nerfattack.fields.occupancy import Window
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")

SHAPE = (6, 5, 4)


def some_cells(rng: np.random.Generator) -> np.ndarray:
    return rng.random(SHAPE) < 0.6


def points(rng: np.random.Generator, count: int = 20_000) -> np.ndarray:
    """Draw points in the unit box and a little outside, (n, 3) float32."""
    return rng.uniform(-0.1, 1.1, (count, 3)).astype(np.float32)


def test_the_factor_is_that_of_the_definition(rng) -> None:
    cells, unit = some_cells(rng), points(rng)
    factor = Window(cells)(mi.Point3f(unit.T), mi.Bool(True)).numpy()
    expected = window(cells, unit.astype(float))
    np.testing.assert_allclose(factor, expected, atol=1e-4)
    assert (factor[expected == 0] == 0).all()
    assert 0.1 < (factor == 1).mean() < 0.7
    assert ((factor > 0.01) & (factor < 0.99)).sum() > 500
    everywhere = Window(np.ones(SHAPE, bool))(mi.Point3f(unit.T), mi.Bool(True))
    assert (everywhere.numpy() == 1).all()  # no empty cell: it ends at its box


def test_the_slope_is_that_of_the_factor(rng) -> None:
    cells, unit = some_cells(rng), points(rng)
    place = mi.Point3f(unit.T)
    dr.enable_grad(place)
    dr.backward(Window(cells)(place, mi.Bool(True)))
    slope = dr.grad(place).numpy().T

    along, h = rng.normal(size=unit.shape), 1e-6
    ends = [window(cells, unit.astype(float) + s * along) for s in (h, -h)]
    expected = (ends[0] - ends[1]) / (2 * h)
    wrong = np.abs((slope * along).sum(1) - expected) > 1e-2 * (1 + np.abs(expected))
    inside = ((unit > 0) & (unit < 1)).all(1)
    assert wrong[inside].mean() < 1e-3  # at kinks, and within 1e-6 of them


@pytest.mark.parametrize("make", [homogeneous, small_ngp])
def test_whatever_evaluates_a_field_sees_the_same(make, rng) -> None:
    field = make()
    everywhere = field.density(mi.Point3f(0.1, 0.2, 0.3), mi.Bool(True))[0]
    assert everywhere > 0
    cells, unit = some_cells(rng), points(rng)
    field.occupy(Occupancy(cells))
    place = mi.Point3f((field.lower + unit * (field.upper - field.lower)).T)
    heading, active = mi.Vector3f(0, 0, 1), mi.Bool(True)
    expected = field.density_everywhere(place, active).numpy()
    expected *= window(cells, unit.astype(float))
    densities = [field.eval(place, heading, active)[0], field.density(place, active)]
    if field.kind == "ngp_field":
        packed = PackedNGP(field)
        densities.append(packed.eval(place, packed.view(heading), active)[0])
    for density in densities:
        limit = 1e-4 * expected.max()
        np.testing.assert_allclose(density.numpy(), expected, atol=limit)


def test_a_distant_object_is_as_sharp_as_a_near_one() -> None:
    """Parallel rays from 1 km and from 1 m: single precision must not show."""
    field = homogeneous(40.0)
    field.lower, field.upper, field.step_m = -0.04 * ONES, 0.04 * ONES, 2**-10
    cells = np.zeros((16, 16, 16), bool)
    cells[3:13, 3:13, 3:13] = True
    field.occupy(Occupancy(cells))
    y, z = np.meshgrid(*[np.linspace(-0.045, 0.045, 91)] * 2)
    posed = PosedField(field)

    def image(distance: float) -> np.ndarray:
        origin = mi.Point3f(-distance, y.ravel(), z.ravel())
        rays = Rays(origin, mi.Vector3f(1, 0, 0), mi.Float(np.inf), mi.Float(0.5))
        dr.make_opaque(rays)
        return march(posed, rays).opacity.numpy()

    near = image(1.0)  # both distances are whole steps
    assert 0.2 < near.mean() < 0.6
    np.testing.assert_allclose(image(1000.0), near, atol=1e-4)
