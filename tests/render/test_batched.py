"""Gradients of an NGP by collected points, against the march's own derivative."""

from __future__ import annotations

from contextlib import nullcontext

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.kernels import nothing_compiled

from mi_nerfattack.fields import NGPField
from mi_nerfattack.render import batched
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

pytestmark = pytest.mark.usefixtures("variant")

COUNT = 48
STOP = 1e-3
NAMES = ("table", "density_weights", "colour_weights")


@pytest.fixture
def posed() -> PosedField:
    return PosedField(small.small_ngp(cone=0.01), Pose.upright((0.2, 0.1, 0), 0.3, 1.7))


def make_rays(rng: np.random.Generator, count: int = COUNT) -> Rays:
    origin, direction, _, _ = small.fan(rng, count)
    return Rays(origin, direction, dr.opaque(mi.Float, 10), dr.opaque(mi.Float, 0.5))


def attach(field: NGPField, names: tuple[str, ...]) -> None:
    for name in NAMES:
        value = field.parameters()[name]
        leaf = type(value)(dr.detach(value))
        if name in names:
            dr.enable_grad(leaf)
        field.set_parameter(name, leaf)


def gradients(field: NGPField) -> list[np.ndarray]:
    values = field.parameters()
    return [dr.grad(values[name]).numpy().copy() for name in NAMES]


def recorded(posed: PosedField, rays: Rays, primal: March, cotangent: March):
    attach(posed.field, NAMES)
    march_derivative(dr.ADMode.Backward, posed, rays, primal, cotangent, STOP)
    return gradients(posed.field)


@pytest.mark.parametrize("capacity", [1 << 17, 200, 3])
@pytest.mark.parametrize("block", [1 << 12, 64])
def test_equals_the_recorded_derivative(posed, rng, monkeypatch, capacity, block):
    monkeypatch.setattr(batched, "CAPACITY", capacity)
    monkeypatch.setattr("mi_nerfattack.fields.cpu.matrices.BLOCK", block)
    rays = make_rays(rng)
    primal = march(posed, rays, STOP)
    cotangent = small.random_march(rng, COUNT)
    expected = recorded(posed, rays, primal, cotangent)
    attach(posed.field, NAMES)
    batched.march_gradient(posed, rays, primal, cotangent, STOP)
    for found, wanted in zip(gradients(posed.field), expected, strict=True):
        scale = np.abs(wanted).max()
        assert scale > 0.1
        np.testing.assert_allclose(found, wanted, atol=1e-5 * scale)


@pytest.mark.parametrize("name", NAMES)
def test_only_what_asks_gets_a_gradient(posed, rng, name) -> None:
    rays = make_rays(rng)
    primal = march(posed, rays, STOP)
    cotangent = small.random_march(rng, COUNT)
    attach(posed.field, (name,))
    batched.march_gradient(posed, rays, primal, cotangent, STOP)
    for other, found in zip(NAMES, gradients(posed.field), strict=True):
        assert (np.abs(found).max() > 0) == (other == name)


def test_rays_that_miss_add_nothing(posed, rng) -> None:
    rays = make_rays(rng)
    rays.origin += mi.Vector3f(0, 50, 0)
    primal = march(posed, rays, STOP)
    attach(posed.field, NAMES)
    batched.march_gradient(posed, rays, primal, small.random_march(rng, COUNT), STOP)
    assert all((found == 0).all() for found in gradients(posed.field))


def test_gradients_add_up_over_passes(posed, rng) -> None:
    rays = make_rays(rng)
    primal = march(posed, rays, STOP)
    cotangent = small.random_march(rng, COUNT)
    attach(posed.field, NAMES)
    batched.march_gradient(posed, rays, primal, cotangent, STOP)
    once = gradients(posed.field)
    batched.march_gradient(posed, rays, primal, cotangent, STOP)
    for twice, first in zip(gradients(posed.field), once, strict=True):
        np.testing.assert_allclose(twice, 2 * first, atol=1e-4 * np.abs(first).max())


def test_nothing_is_compiled_for_other_numbers_of_points(posed, rng) -> None:
    for count, watch in (
        (40, nullcontext),
        (40, nothing_compiled),
        (31, nothing_compiled),
    ):
        rays = make_rays(rng, count)
        primal = march(posed, rays, STOP)
        cotangent = small.random_march(rng, count)
        attach(posed.field, NAMES)
        dr.eval(rays, primal, cotangent)  # NumPy's strides are part of a kernel
        with watch():
            batched.march_gradient(posed, rays, primal, cotangent, STOP)
            dr.eval([dr.grad(posed.field.parameters()[name]) for name in NAMES])
