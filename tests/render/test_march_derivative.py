"""Derivatives through composites: central differences and the dot-product identity."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.files import objects as made
from support.reference.derivatives import central_difference
from support.worlds import fields as small

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import AbstractField, GridField, GridLayout, Occupancy
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import DepthComposite, Marches
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.splatting.background import SplatBackground

pytestmark = pytest.mark.usefixtures("variant")

COUNT = 32
POSE = Pose.upright((0.1, 0.0, 0.0), 0.3, 1.2)


class Case:
    """Layers or a field, rays, and a random objective, linear in what is seen."""

    def __init__(self, rng, layers, composite=None, inside: bool = False) -> None:
        is_field = isinstance(layers, AbstractField)
        self.layers = [PosedField(layers, POSE)] if is_field else layers
        self.composite = composite or DepthComposite()
        origin, direction, _, _ = small.fan(rng, COUNT)
        shift = mi.Vector3f(2.5 if inside else 0, 0, 0)
        t_max = 0.8 if inside else 10.0
        self.rays = small.arguments(self.layers[0], origin + shift, direction, t_max)[1]
        self.cotangent = small.random_march(rng, COUNT)

    def objective(self) -> float:
        primal = self.composite.render(self.layers, self.rays, 0.0)
        return small.pairing(primal.total, self.cotangent)

    def backward(self) -> None:
        primal = self.composite.render(self.layers, self.rays, 0.0)
        cotangent = Marches(self.cotangent)
        self.composite.backward(self.layers, self.rays, primal, cotangent, 0.0)

    def forward(self) -> float:
        primal = self.composite.render(self.layers, self.rays, 0.0)
        derivative = self.composite.forward(self.layers, self.rays, primal, 0.0)
        return small.pairing(derivative.total, self.cotangent)

    def gradients(self) -> list[np.ndarray]:
        """Differentiate by the first field's parameters, by origin and direction."""
        field = self.layers[0].field
        is_grid = isinstance(field, GridField)
        packed = mi.Float(field.packed if is_grid else 0)
        if is_grid:
            dr.enable_grad(packed)
            field.packed = packed
        primal = self.composite.render(self.layers, self.rays, 0.0)
        arguments = self.layers, self.rays, primal, Marches(self.cotangent)
        (by_rays,) = self.composite.backward_rays(*arguments, 0.0, [0])
        gradients = [dr.grad(packed), by_rays.origin, by_rays.direction]
        return [value.numpy().copy() for value in gradients]


@pytest.fixture
def blob(rng: np.random.Generator) -> Case:
    return Case(rng, small.blob(rng))


def check_parameter(case: Case, k: int, name: str, tangent, h: float, rel: float):
    """Compare difference, forward and backward derivative along one tangent."""
    field = case.layers[k].field

    def read() -> mi.Float:
        return field.packed if name == "packed" else field.parameters()[name]

    kind, base = type(read()), np.array(read().numpy())

    def write(values: np.ndarray, attach: bool = False) -> None:
        value = kind(values.astype(base.dtype))
        if attach:
            dr.enable_grad(value)
        if name == "packed":
            field.packed = value
        else:
            field.set_parameter(name, value)

    def shifted(s: float) -> float:
        write(base + s * tangent)
        return case.objective()

    expected = central_difference(shifted, h)
    write(base, attach=True)
    case.backward()
    backward = float(np.dot(dr.grad(read()).numpy().astype(float), tangent))
    write(base, attach=True)
    dr.set_grad(read(), kind(tangent.astype(base.dtype)))
    assert case.forward() == pytest.approx(backward, rel=1e-3)  # dot-product identity
    assert backward == pytest.approx(expected, rel=rel)


def overlapping(rng: np.random.Generator) -> list[PosedField]:
    """Make two blobs of different scale, step and pose that overlap."""
    place = Pose.upright((0.2, 0.1, 0.1), 0.4, 0.7)
    one = PosedField(small.blob(rng, step_m=0.03))
    return [one, PosedField(small.blob(rng, 3.0, 0.05), place)]


@pytest.mark.parametrize("k", [0, 1])
@pytest.mark.parametrize("composite", [DepthComposite(), InterleavedComposite()])
def test_packed_parameters_of_two_grids(rng, composite, k: int) -> None:
    case = Case(rng, overlapping(rng), composite)
    tangent = rng.normal(size=dr.width(case.layers[k].field.packed))
    check_parameter(case, k, "packed", tangent, 2e-2, 1e-3)


def test_texture_between_splats(rng) -> None:
    veil = made.splats([[-2, 0, 0], [-1.8, 0.1, 0.2]], [0.8, 0.1, 0.2], 0.5, 0.4)
    splats = SplatBackground(made.wall(4)), SplatBackground(veil)
    case = Case(rng, [*splats, PosedField(small.blob(rng))])
    tangent = rng.normal(size=(case.layers[2].field.n_vertices, 4))
    tangent[:, 0] = 0
    check_parameter(case, 2, "packed", tangent.ravel(), 0.2, 2e-3)


@pytest.mark.parametrize(
    "name",
    [
        "table",
        "colour_weights",
        pytest.param("density_weights", marks=pytest.mark.slow),
    ],
)
def test_parameters_of_an_ngp(rng, name: str) -> None:
    ngp = Case(rng, small.small_ngp())
    tangent = rng.normal(size=dr.width(ngp.layers[0].field.parameters()[name]))
    # Rectified networks have kinks, which a difference of finite step crosses.
    check_parameter(ngp, 0, name, tangent, 2e-3, 2e-2)


def test_gradient_accumulates_over_passes(blob: Case) -> None:
    once = blob.gradients()[0]
    blob.backward()
    twice = dr.grad(blob.layers[0].field.packed).numpy()
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-3, atol=1e-6)


def check_rays(case: Case, rng, h: float, tolerance: float) -> None:
    """Compare the derivatives by origin and direction with differences."""
    _, *gradients = case.gradients()
    tangent = rng.normal(size=(3, COUNT)).astype(np.float32)
    for name, gradient in zip(("origin", "direction"), gradients, strict=True):
        before = getattr(case.rays, name)

        def shifted(s: float, name=name, before=before) -> float:
            setattr(case.rays, name, before + s * mi.Vector3f(tangent))
            return case.objective()

        expected = central_difference(shifted, h)
        setattr(case.rays, name, before)
        derivative = float((gradient.astype(float) * tangent).sum())
        assert derivative == pytest.approx(expected, rel=tolerance, abs=1e-3)


def test_derivative_by_the_density_of_a_slab() -> None:
    # The second of the rays misses the slab.
    origin = mi.Point3f([-3, -3], [0.1, 5], 0.2)
    posed = PosedField(small.homogeneous(0.7))
    rays = small.arguments(posed, origin, mi.Vector3f(1, 0, 0) + 0 * origin)[1]
    primal = march(posed, rays, 0.0)
    one = mi.Float(1, 1)
    cotangent = March(mi.Color3f(0.5, -2, 1) * one, 0.3 * one, -0.4 * one)
    backward = dr.ADMode.Backward
    _, by_ray = march_derivative(backward, posed, rays, primal, cotangent, 0.0, True)
    colour = small.sigmoid_to_linear(np.array(0.3))

    def objective(s: float) -> float:
        density = 0.7 * np.exp(s)
        passed = np.exp(-2 * density)
        moment = 2 * (1 - passed) + 1 / density - (2 + 1 / density) * passed
        return (-0.5 * colour + 0.3) * (1 - passed) - 0.4 * moment

    expected = [central_difference(objective, 1e-4), 0]
    np.testing.assert_allclose(by_ray.log_density.numpy(), expected, rtol=1e-3)


def test_origin_and_direction_within_one_cell(rng: np.random.Generator) -> None:
    # No kinks, and rays that begin and end inside: the derivative is exact.
    field = GridField(GridLayout(1, 2, 2), -small.ONES, small.ONES, step_m=0.05)
    noise = rng.normal(size=(field.n_vertices, 4)).astype(np.float32)
    field.packed = mi.Float(noise.ravel())
    check_rays(Case(rng, field, inside=True), rng, 1e-2, 1e-3)


def test_bricks_have_no_derivatives_by_rays(rng) -> None:
    back, front = PosedField(small.small_bricks(rng)), PosedField(small.blob(rng))
    layers, composite = [back, front], DepthComposite()
    rays = Rays(*small.fan(rng)[:2])
    primal = composite.render(layers, rays, 0.0)
    cotangent = Marches(small.random_march(rng, dr.width(rays.direction)))
    with pytest.raises(InputError, match="keep the camera detached") as caught:
        composite.backward_rays(layers, rays, primal, cotangent, 0.0, [0, 1])
    assert caught.value.where == "brick_field"
    # the objects among them have such derivatives, which poses are attacked by
    (by_rays,) = composite.backward_rays(layers, rays, primal, cotangent, 0.0, [1])
    by_origin = by_rays.origin.numpy()
    assert np.isfinite(by_origin).all() and by_origin.any()


def test_direction_also_turns_the_view_of_an_ngp(rng: np.random.Generator) -> None:
    # Equal table entries: density is constant, colour depends on direction alone.
    field = small.small_ngp()
    width = dr.width(field.parameters()["table"])
    field.set_parameter("table", mi.Float(np.full(width, 0.5, np.float32)))
    case = Case(rng, field, inside=True)
    _, by_origin, by_direction = case.gradients()
    assert np.abs(by_origin).max() < 1e-4
    assert np.abs(by_direction).max() > 1e-2
    check_rays(case, rng, 2e-3, 2e-2)


def test_skipped_cells_have_no_gradient(rng: np.random.Generator) -> None:
    field = small.blob(rng)
    cells = np.ones((4, 4, 4), bool)
    cells[:, :, 2:] = False  # z > 0
    field.occupy(Occupancy(cells))
    gradient = Case(rng, [PosedField(field)]).gradients()[0]
    gradient = np.abs(gradient.reshape(-1, 4)).max(1)
    height = small.vertices(field)[:, 2]
    coarsest = 2 / (small.SMALL.base_resolution - 1)
    assert gradient[height < 0].max() > 1e-3
    assert gradient[height > coarsest + 1e-3].max() == 0


def test_rays_that_miss_have_zero_gradient(blob: Case) -> None:
    blob.rays.origin += mi.Vector3f(0, 50, 0)
    assert not any(value.any() for value in blob.gradients())


@pytest.mark.parametrize("density", [1e-6, 1e4])
def test_gradient_is_finite_near_opacity_0_and_1(rng, density: float) -> None:
    gradients = Case(rng, small.homogeneous(density)).gradients()
    assert all(np.isfinite(value).all() for value in gradients)
    assert np.abs(gradients[0]).max() > 0


def test_march_itself_records_nothing(blob: Case) -> None:
    dr.enable_grad(blob.layers[0].field.packed)
    integrals = march(blob.layers[0], blob.rays, 0.0)
    assert not dr.grad_enabled(integrals.radiance, integrals.opacity, integrals.moment)
