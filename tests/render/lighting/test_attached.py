"""A composite as a differentiable operation, by itself and in a recorded loop."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.derivatives import central_difference

from mi_nerfattack.render.composite import DepthComposite
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.lighting.attached import attached
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")


@dr.syntax
def looped(composite, posed: list, rays: Rays, count: int) -> mi.Color3f:
    """Sum a composite over rays that step sideways, in one recorded loop."""
    i = mi.UInt32(0)
    total = mi.Color3f(0)
    while i < count:
        offset = 0.1 * mi.Float(i)
        moved = Rays(
            rays.origin + mi.Vector3f(0, 0, 1) * offset,
            rays.direction,
            rays.t_max,
            rays.jitter,
            rays.active,
        )
        radiance, opacity = attached(composite, posed, moved, 0.0)
        total += radiance + opacity
        i += 1
    return total


@pytest.fixture
def rays(rng: np.random.Generator) -> Rays:
    origin, direction, _, _ = small.fan(rng)
    return Rays(origin, direction, mi.Float(10), mi.Float(0.5), mi.Bool(True))


@pytest.mark.parametrize("composite", [InterleavedComposite(), DepthComposite()])
def test_derivatives_agree_with_central_differences(rays, composite, rng) -> None:
    fields = [small.blob(rng, step_m=0.1), small.blob(rng, step_m=0.1)]
    posed = [PosedField(field) for field in fields]
    field = fields[0]
    base = field.texture.numpy().copy()
    tangent = rng.normal(0, 1, base.shape).astype(np.float32)

    def value(s: float) -> float:
        field.set_parameter("texture", base + np.float32(s) * tangent)
        radiance, opacity = attached(composite, posed, rays, 0.0)
        return float((radiance + opacity).numpy().astype(float).sum())

    expected = central_difference(value, 0.05)
    texture = mi.TensorXf(base)
    dr.enable_grad(texture)
    field.set_parameter("texture", texture)
    radiance, opacity = attached(composite, posed, rays, 0.0)
    dr.backward(dr.sum(radiance + opacity, axis=None))
    backward = (dr.grad(texture).numpy().astype(float) * tangent).sum()
    assert backward == pytest.approx(expected, rel=1e-3)

    texture = mi.TensorXf(base)
    dr.enable_grad(texture)
    field.set_parameter("texture", texture)
    dr.set_grad(texture, mi.TensorXf(tangent))
    dr.forward_from(texture, dr.ADFlag.ClearEdges)
    radiance, opacity = attached(composite, posed, rays, 0.0)
    found = dr.forward_to(radiance + opacity).numpy().astype(float).sum()
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("composite", [InterleavedComposite(), DepthComposite()])
def test_forward_derivative_inside_a_recorded_loop(rays, composite, rng) -> None:
    field = small.blob(rng, step_m=0.1)
    posed = [PosedField(field)]
    base = field.texture.numpy().copy()
    tangent = rng.normal(0, 1, base.shape).astype(np.float32)

    def value(s: float) -> float:
        field.set_parameter("texture", base + np.float32(s) * tangent)
        return float(looped(composite, posed, rays, 3).numpy().astype(float).sum())

    expected = central_difference(value, 0.05)
    texture = mi.TensorXf(base)
    dr.enable_grad(texture)
    field.set_parameter("texture", texture)
    dr.set_grad(texture, mi.TensorXf(tangent))
    dr.forward_from(texture, dr.ADFlag.ClearEdges)
    found = dr.forward_to(looped(composite, posed, rays, 3)).numpy().astype(float)
    assert found.sum() == pytest.approx(expected, rel=1e-3)


def test_nothing_is_attached_without_gradients(rays, rng) -> None:
    posed = [PosedField(small.blob(rng))]
    radiance, opacity = attached(InterleavedComposite(), posed, rays, 0.0)
    assert not dr.grad_enabled(radiance) and not dr.grad_enabled(opacity)
