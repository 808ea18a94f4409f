"""The analytic loop itself: its two versions agree, derivatives included."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import analytic_loop as analytic

from mi_nerfattack.rollout.loop import simulate
from mi_nerfattack.vehicle.state import to_state

pytestmark = pytest.mark.usefixtures("variant")


def parameters(loop):
    """Textures of the sensor as leaves of torch."""
    return [
        torch.tensor(texture.numpy(), requires_grad=True)
        for texture in loop.sensor.textures()
    ]


@pytest.mark.parametrize(
    ("vehicle", "integrator", "substeps", "delay"),
    [
        ("dubins", "euler", 1, 0),
        ("ackermann", "rk4", 1, 2),
        ("bicycle", "rk4", 2, 3),
        ("ackermann_rate", "rk4", 2, 1),
        ("ackermann_rate", "implicit_midpoint", 3, 2),
    ],
)
def test_drives_agree(vehicle, integrator, substeps, delay):
    loop, twin = analytic.make_pair(vehicle, integrator, substeps, delay, objects=2)
    initial = loop.dynamics.extend(analytic.random_poses(3))
    drive = simulate(loop, to_state(initial), 12)
    states, controls = twin.drive(torch.tensor(initial), parameters(loop), 12, True)
    np.testing.assert_allclose(
        drive.states_numpy(), states.detach(), rtol=0, atol=1e-11
    )
    np.testing.assert_allclose(
        drive.controls_numpy(), controls.detach(), rtol=0, atol=1e-12
    )
    assert np.ptp(controls.detach().numpy()) > 0.3  # the drive is not a straight line


def test_sensor_derivatives_are_autograd_s(rng):
    loop, _ = analytic.make_pair(objects=2)
    sensor, poses = loop.sensor, analytic.random_poses(3)
    offsets = rng.normal(0, 0.4, (2, 6))
    sensor.set_offsets(offsets)
    state = to_state(poses)
    seen = sensor.observe(state, 5)
    leaves = [torch.tensor(poses), torch.tensor(offsets)]
    leaves = [leaf.requires_grad_() for leaf in leaves] + parameters(loop)
    image = analytic.torch_image(leaves[0], 5, leaves[2:], leaves[1])
    np.testing.assert_allclose(seen.image.numpy(), image.detach(), rtol=1e-13)
    assert image.min() > 0 and image.max() < 1 and image.detach().std() > 0.1
    cotangent = rng.normal(size=image.shape)
    expected = torch.autograd.grad(image, leaves, torch.tensor(cotangent))
    sensor.start_gradient(True)
    assert sensor.vjp(seen, state, analytic.tensor(cotangent), False) is None
    by_state = sensor.vjp(seen, state, analytic.tensor(cotangent), True)
    np.testing.assert_allclose(by_state.numpy().T, expected[0], rtol=1e-11)
    np.testing.assert_allclose(  # accumulated twice
        sensor.offset_gradients() / 2, expected[1], rtol=1e-11, atol=1e-13
    )
    for found, gradient in zip(sensor.texture_gradients(), expected[2:], strict=True):
        np.testing.assert_allclose(found.numpy() / 2, gradient, rtol=1e-11)


@pytest.mark.parametrize("follow", [True, False])
def test_sensor_tangent_is_the_transpose(rng, follow):
    loop, _ = analytic.make_pair()
    sensor, state = loop.sensor, to_state(analytic.random_poses(2))
    seen = sensor.observe(state, 1)
    tangents = [rng.normal(size=(2, 3)), rng.normal(size=(analytic.TEXELS, 3))]
    sensor.start_tangent([analytic.tensor(tangents[1])])
    image = sensor.jvp(seen, state, to_state(tangents[0]) if follow else None)
    cotangent = rng.normal(size=image.shape)
    sensor.start_gradient()
    by_state = sensor.vjp(seen, state, analytic.tensor(cotangent), follow)
    right = (sensor.texture_gradients()[0].numpy() * tangents[1]).sum()
    if follow:
        right += (by_state.numpy().T * tangents[0]).sum()
    assert (image.numpy() * cotangent).sum() == pytest.approx(right, rel=1e-11)


def test_the_torch_policy_keeps_double_precision(rng):
    loop, twin = analytic.make_pair()
    pixels = rng.uniform(size=(3, analytic.HEIGHT, analytic.WIDTH, 3))
    control = loop.policy.control(analytic.tensor(pixels), 1)
    leaf = torch.tensor(pixels, requires_grad=True)
    expected = twin.module(leaf.permute(0, 3, 1, 2), torch.full((3,), 1))
    assert control.numpy().dtype == np.float64
    np.testing.assert_allclose(control.numpy(), expected.detach(), rtol=1e-15)
    weight = analytic.row_type()([0.5, -1.0, 2.0])
    _, gradient = loop.policy.vjp(analytic.tensor(pixels), 1, weight)
    (by_image,) = torch.autograd.grad(expected, leaf, torch.tensor([0.5, -1.0, 2.0]))
    np.testing.assert_allclose(gradient.numpy(), by_image, rtol=1e-13)
