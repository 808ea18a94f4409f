"""Derivatives of the march: central differences and the dot-product identity."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.derivatives import central_difference
from helpers.variants import later

from mi_nerfattack.fields import AbstractField, GridField, GridLayout, Occupancy
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March

pytestmark = pytest.mark.usefixtures("variant")

COUNT = 32
POSE = Pose.upright((0.1, 0.0, 0.0), 0.3, 1.2)


class Setting:
    """A field under test, its rays and a random objective, linear in the march."""

    def __init__(
        self, rng: np.random.Generator, field: AbstractField, inside: bool = False
    ) -> None:
        self.field = field
        self.posed = PosedField(field, POSE)
        self.origin, self.direction, _, _ = small.fan(rng, COUNT)
        self.t_max = 10.0
        if inside:
            self.origin, self.t_max = self.origin + mi.Vector3f(2.5, 0, 0), 0.8
        self.cotangent = small.random_march(rng, COUNT)

    def attach(self) -> mi.Float:
        """Make the grid's parameters a leaf, and return it."""
        packed = mi.Float(self.field.packed)
        dr.enable_grad(packed)
        self.field.packed = packed
        return packed

    def march(self, origin=None, direction=None) -> March:
        o = self.origin if origin is None else origin
        d = self.direction if direction is None else direction
        return march(*small.arguments(self.posed, o, d, self.t_max), 0.0)

    def objective(self, *rays) -> float:
        return small.pairing(self.march(*rays), self.cotangent)

    def derivative(self, mode: dr.ADMode):
        primal = self.march()
        rays = (self.origin, self.direction)
        fixed = small.arguments(self.posed, *rays, self.t_max)
        with_rays = mode == dr.ADMode.Backward
        result = march_derivative(mode, *fixed, primal, self.cotangent, 0.0, with_rays)
        dr.eval(result)
        return result


@pytest.fixture
def blob(rng: np.random.Generator) -> Setting:
    return Setting(rng, small.blob(rng))


@pytest.fixture
def ngp(rng: np.random.Generator) -> Setting:
    return Setting(rng, small.small_ngp())


def check_parameter(
    setting: Setting,
    read: Callable[[], mi.Float],
    write: Callable[[mi.Float], None],
    tangent: np.ndarray,
    h: float,
    tolerance: float,
) -> None:
    """Compare difference, forward and backward derivative along one tangent."""
    kind = type(read())
    base = np.array(read().numpy())

    def shifted(s: float) -> float:
        write(kind((base + s * tangent).astype(base.dtype)))
        return setting.objective()

    expected = central_difference(shifted, h)
    leaf = kind(base)
    dr.enable_grad(leaf)
    write(leaf)
    setting.derivative(dr.ADMode.Backward)
    backward = float(np.dot(dr.grad(read()).numpy().astype(float), tangent))

    leaf = kind(base)
    dr.enable_grad(leaf)
    write(leaf)
    dr.set_grad(read(), kind(tangent.astype(base.dtype)))
    forward = small.pairing(setting.derivative(dr.ADMode.Forward)[0], setting.cotangent)
    assert forward == pytest.approx(backward, rel=1e-3)  # dot-product identity
    assert backward == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize("others", [0, slice(1, 4)], ids=["texture", "density"])
def test_packed_parameters_of_a_grid(blob: Setting, rng, others) -> None:
    field = blob.field
    tangent = rng.normal(size=(field.n_vertices, 4))
    tangent[:, others] = 0

    def write(value: mi.Float) -> None:
        field.packed = value

    check_parameter(blob, lambda: field.packed, write, tangent.ravel(), 2e-2, 5e-3)


@pytest.mark.parametrize("name", ["table", "colour_weights", *later("density_weights")])
def test_parameters_of_an_ngp(ngp: Setting, rng, name: str) -> None:
    field = ngp.field

    def write(value: mi.Float) -> None:
        field.set_parameter(name, value)

    tangent = rng.normal(size=dr.width(field.parameters()[name]))
    # Rectified networks have kinks, which a difference of finite step crosses.
    check_parameter(ngp, lambda: field.parameters()[name], write, tangent, 2e-3, 2e-2)


def test_gradient_accumulates_over_passes(blob: Setting) -> None:
    packed = blob.attach()
    blob.derivative(dr.ADMode.Backward)
    once = dr.grad(packed).numpy().copy()
    blob.derivative(dr.ADMode.Backward)
    np.testing.assert_allclose(dr.grad(packed), 2 * once, rtol=1e-3, atol=1e-6)


def check_rays(setting: Setting, rng, h: float, tolerance: float) -> None:
    """Compare the derivatives by origin and direction with differences."""
    by_rays = setting.derivative(dr.ADMode.Backward)[1]
    d_origin, d_direction = by_rays.origin, by_rays.direction
    tangent = rng.normal(size=(3, COUNT)).astype(np.float32)

    def by_origin(s: float) -> float:
        return setting.objective(setting.origin + s * mi.Vector3f(tangent))

    def by_direction(s: float) -> float:
        return setting.objective(None, setting.direction + s * mi.Vector3f(tangent))

    for function, gradient in ((by_origin, d_origin), (by_direction, d_direction)):
        found = float((gradient.numpy().astype(float) * tangent).sum())
        expected = central_difference(function, h)
        assert found == pytest.approx(expected, rel=tolerance, abs=1e-3)


@pytest.mark.slow
def test_origin_and_direction_through_a_blob(blob: Setting, rng) -> None:
    # Samples that cross the faces of cells, kinks of the field, cost accuracy.
    check_rays(blob, rng, 1e-3, 1.5e-2)


def test_origin_and_direction_within_one_cell(rng: np.random.Generator) -> None:
    # No kinks, and rays that begin and end inside: the derivative is exact.
    field = GridField(GridLayout(1, 2, 2), -small.ONES, small.ONES, step_m=0.05)
    noise = rng.normal(size=(field.n_vertices, 4)).astype(np.float32)
    field.packed = mi.Float(noise.ravel())
    check_rays(Setting(rng, field, inside=True), rng, 1e-2, 1e-3)


def test_direction_also_turns_the_view_of_an_ngp(rng: np.random.Generator) -> None:
    # Equal table entries: density is constant, colour depends on direction alone.
    field = small.small_ngp()
    width = dr.width(field.parameters()["table"])
    field.set_parameter("table", mi.Float(np.full(width, 0.5, np.float32)))
    setting = Setting(rng, field, inside=True)
    by_rays = setting.derivative(dr.ADMode.Backward)[1]
    d_origin, d_direction = by_rays.origin, by_rays.direction
    assert np.abs(d_origin.numpy()).max() < 1e-4
    assert np.abs(d_direction.numpy()).max() > 1e-2
    check_rays(setting, rng, 2e-3, 2e-2)


def test_skipped_cells_have_no_gradient(rng: np.random.Generator) -> None:
    field = small.blob(rng)
    cells = np.ones((4, 4, 4), bool)
    cells[:, :, 2:] = False  # z > 0
    field.occupy(Occupancy(cells))
    setting = Setting(rng, field)
    setting.posed = PosedField(field)
    packed = setting.attach()
    setting.derivative(dr.ADMode.Backward)
    gradient = np.abs(dr.grad(packed).numpy().reshape(-1, 4)).max(1)
    height = small.vertices(field)[:, 2]
    coarsest = 2 / (small.SMALL.base_resolution - 1)
    assert gradient[height < 0].max() > 1e-3
    assert gradient[height > coarsest + 1e-3].max() == 0


def test_rays_that_miss_have_zero_gradient(blob: Setting) -> None:
    blob.origin = blob.origin + mi.Vector3f(0, 50, 0)
    packed = blob.attach()
    by_rays = blob.derivative(dr.ADMode.Backward)[1]
    d_origin, d_direction = by_rays.origin, by_rays.direction
    for value in (dr.grad(packed), d_origin, d_direction):
        assert (value.numpy() == 0).all()


@pytest.mark.parametrize("density", [1e-6, 1e4])
def test_gradient_is_finite_near_opacity_0_and_1(rng, density: float) -> None:
    setting = Setting(rng, small.homogeneous(density))
    packed = setting.attach()
    by_rays = setting.derivative(dr.ADMode.Backward)[1]
    d_origin, d_direction = by_rays.origin, by_rays.direction
    for value in (dr.grad(packed), d_origin, d_direction):
        assert np.isfinite(value.numpy()).all()
    assert np.abs(dr.grad(packed).numpy()).max() > 0


def test_march_itself_records_nothing(blob: Setting) -> None:
    blob.attach()
    seen = blob.march()
    assert not dr.grad_enabled(seen.radiance, seen.opacity, seen.moment)
