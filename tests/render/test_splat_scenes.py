"""Splats among fields: the depth composite, its derivatives, and the sensor."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers import splat_files as made
from helpers.derivatives import central_difference
from helpers.kernels import nothing_compiled

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import DepthComposite, Seen
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.splats import SplatBackground

pytestmark = pytest.mark.usefixtures("variant")

RED, BLUE = np.array([0.8, 0.1, 0.2]), np.array([0.1, 0.3, 0.9])
DENSITY, RAW = 0.7, 0.3
COLOUR = float(small.sigmoid_to_linear(np.array(RAW)))
CUBE_OPACITY = 1 - np.exp(-2 * DENSITY)


def cube(x: float) -> PosedField:
    """Place a homogeneous cube of edge 2 on the x axis."""
    pose = Pose(np.eye(3), np.array([x, 0.0, 0.0]))
    return PosedField(small.homogeneous(DENSITY, RAW), pose)


def along_x(origin=(0.0, 0.0, 0.0)) -> Rays:
    """Make one ray."""
    rays = Rays(mi.Point3f(*origin), mi.Vector3f(1, 0, 0))
    dr.make_opaque(rays)
    return rays


@pytest.mark.parametrize("splat_first", [True, False])
def test_a_splat_hides_and_is_hidden_by_depth(splat_first: bool) -> None:
    splat = SplatBackground(made.splats([2 if splat_first else 9, 0, 0], RED, 0.6))
    layers = [splat, cube(5)]
    seen = DepthComposite().render(layers, along_x(), 0.0)
    parts = [
        (0.6, srgb_to_linear_numpy(RED), 2.0 if splat_first else 9.0),
        (CUBE_OPACITY, np.full(3, COLOUR), float(seen.layers[1].depth[0])),
    ]
    (a, front, z), (b, back, far) = parts if splat_first else parts[::-1]
    expected = a * front + (1 - a) * b * back
    np.testing.assert_allclose(seen.total.radiance.numpy()[:, 0], expected, rtol=2e-4)
    assert float(seen.total.opacity[0]) == pytest.approx(a + (1 - a) * b, rel=2e-4)
    moment = a * z + (1 - a) * b * far
    assert float(seen.total.moment[0]) == pytest.approx(moment, rel=2e-4)


# Derivatives


def gradient(layers: list, index: int, rays: Rays, cotangent: March) -> np.ndarray:
    """Return the derivative by the texture of one of the layers."""
    field = layers[index].field
    leaf = mi.Float(dr.detach(field.packed))
    dr.enable_grad(leaf)
    field.packed = leaf
    composite = DepthComposite()
    seen = composite.render(layers, rays, 0.0)
    composite.backward(layers, rays, seen, Seen(cotangent), 0.0)
    result = field.texture_gradient(dr.grad(field.packed)).numpy().copy()
    dr.disable_grad(field.packed)
    return result


def fan_rays(rng) -> Rays:
    """Make rays from x = -3 through [-1, 1]^3."""
    o, d, _, _ = small.fan(rng)
    rays = Rays(o, d)
    dr.make_opaque(rays.t_max, rays.jitter, rays.active)
    return rays


def test_a_texture_between_splats_against_differences(rng) -> None:
    item = PosedField(small.blob(rng))
    veil = made.splats([[-2, 0, 0], [-1.8, 0.1, 0.2]], RED, 0.5, 0.4)
    layers = [SplatBackground(made.wall(4)), SplatBackground(veil), item]
    rays = fan_rays(rng)
    cotangent = small.random_march(rng, dr.width(rays.direction))
    cotangent.moment = mi.Float(0)
    found = gradient(layers, 2, rays, cotangent)
    base = item.field.texture.numpy().copy()
    along = rng.normal(size=base.shape) + 3 * found / np.abs(found).max()

    def value(s: float) -> float:
        item.field.set_parameter("texture", (base + s * along).astype(np.float32))
        total = DepthComposite().render(layers, rays, 0.0).total
        return small.pairing(total, cotangent)

    expected = float((found.astype(float) * along).sum())
    assert central_difference(value, 0.2) == pytest.approx(expected, rel=2e-3)


def test_splats_in_front_dim_a_gradient_and_those_behind_leave_it(rng) -> None:
    item = PosedField(small.blob(rng))
    rays = fan_rays(rng)
    count = dr.width(rays.direction)
    cotangent = March(small.random_march(rng, count).radiance)
    veil = SplatBackground(made.splats([-2, 0, 0], RED, 0.5, 0.5))
    passed = 1 - veil.march(rays, 0.0).opacity
    dimmed = March(cotangent.radiance * passed)
    alone = gradient([item], 0, rays, cotangent)
    behind = gradient([SplatBackground(made.wall(4)), item], 1, rays, cotangent)
    np.testing.assert_allclose(behind, alone, atol=1e-5 * np.abs(alone).max())
    front = gradient([veil, item], 1, rays, cotangent)
    expected = gradient([item], 0, rays, dimmed)
    assert np.abs(expected - alone).max() > 0.1 * np.abs(alone).max()
    np.testing.assert_allclose(front, expected, atol=1e-5 * np.abs(alone).max())


def test_forward_mode_is_the_transpose(rng) -> None:
    item = PosedField(small.blob(rng))
    layers = [SplatBackground(made.wall(4)), item]
    rays = fan_rays(rng)
    cotangent = small.random_march(rng, dr.width(rays.direction))
    found = gradient(layers, 1, rays, cotangent).astype(float)
    field = item.field
    along = rng.normal(size=dr.width(field.packed)).astype(np.float32)
    along.reshape(-1, 4)[:, 0] = 0  # density
    dr.enable_grad(field.packed)
    composite = DepthComposite()
    seen = composite.render(layers, rays, 0.0)
    dr.set_grad(field.packed, mi.Float(along))
    tangent = composite.forward(layers, rays, seen, 0.0).total
    dr.disable_grad(field.packed)
    expected = float((found * along.reshape(-1, 4)[:, 1:]).sum())
    assert small.pairing(tangent, cotangent) == pytest.approx(expected, rel=1e-3)


# Refusals


def test_what_needs_a_density_or_a_camera_path_refuses_by_name() -> None:
    layers = [SplatBackground(made.wall(4)), cube(2)]
    rays = along_x()
    with pytest.raises(InputError, match="splats: .* set composite to depth"):
        InterleavedComposite().check(layers)
    with pytest.raises(InputError, match="splats: .* set composite to depth"):
        InterleavedComposite().render(layers, rays, 0.0)
    seen = DepthComposite().render(layers, rays, 0.0)
    with pytest.raises(InputError, match="splats: .* keep the camera detached"):
        DepthComposite().backward_rays(layers, rays, seen, Seen(March()), 0.0, [0, 1])


# The sensor


@pytest.fixture
def loop() -> Any:
    """The toy loop among splats, and its object."""
    from dataclasses import replace

    from helpers import toy_loop as toy

    from mi_nerfattack.deploy.surrogate.scene import field_sensor

    loop, item = toy.make_loop()
    rng = np.random.default_rng(3)
    places = rng.uniform([2, -6, 0], [20, 6, 4], (200, 3))
    street = made.splats(places, rng.random((200, 3)), 0.5, rng.uniform(0.1, 0.8, 200))
    old = loop.sensor
    view = old.intrinsics, old.mount
    sensor = field_sensor(SplatBackground(street), old.objects, *view, stop=0.0)
    return replace(loop, sensor=sensor), item


def test_the_sensor_differentiates_objects_among_splats(loop, rng) -> None:
    from mi_nerfattack.vehicle.state import to_state

    sensor, item = loop[0].sensor, loop[1]
    state = to_state(np.array([[0.0, 0.35, 0.02]]))
    seen = sensor.observe(state, 0)
    weights = rng.normal(size=seen.image.shape).astype(np.float32)
    sensor.start_gradient()
    sensor.vjp(seen, state, mi.TensorXf(weights), False)
    found = sensor.texture_gradients()[0].numpy().astype(float)
    base = item.texture.numpy().copy()
    along = found / np.abs(found).max() + 0.1 * rng.normal(size=base.shape)

    def value(s: float) -> float:
        item.set_parameter("texture", (base + s * along).astype(np.float32))
        image = np.array(sensor.observe(state, 0).image, np.float64)
        return float((image * weights).sum())

    expected = float((found * along).sum())
    assert central_difference(value, 0.2) == pytest.approx(expected, rel=2e-3)


def test_nothing_is_compiled_after_the_first_steps(loop) -> None:
    from helpers import toy_loop as toy

    from mi_nerfattack.rollout.function import Rollout
    from mi_nerfattack.rollout.objective import StageSum
    from mi_nerfattack.vehicle.state import to_state

    start = np.array([[0.0, 0.35, 0.02]])
    rollout = Rollout(loop[0], StageSum(toy.square_error), 3)
    rollout.gradient(rollout.run(to_state(start)))
    with nothing_compiled():
        rollout.gradient(rollout.run(to_state(start + 0.07)))


def test_a_sensor_refuses_to_merge_splats(loop) -> None:
    from mi_nerfattack.deploy.surrogate.scene import field_sensor

    old = loop[0].sensor
    with pytest.raises(InputError, match="set composite to depth"):
        parts = old.layers[:1], old.objects, old.intrinsics
        field_sensor(*parts, composite="interleaved")
