"""Adjoints through fields against the whole drive on Dr.Jit's tape."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from helpers.rollouts import ADJOINTS, INITIAL, OFFSET, gradient, make_rollout

pytestmark = pytest.mark.usefixtures("variant")

BOTH = np.array([[0.0, 0.35, 0.02], [0.1, -0.2, -0.05]])


def flat(found):
    """Copy all parts of a gradient."""
    textures = [texture.numpy().astype(float) for texture in found.textures]
    return [*textures, np.array(found.initial), *found.offsets, found.costates]


def assert_adjoints_agree(toy, loop, horizon, attached):
    expected, *others = (
        flat(gradient(rollout, BOTH, offsets=True))
        for name in ("tape", *ADJOINTS)
        for rollout in [make_rollout(toy, loop, horizon, attached, name)]
    )
    for found in others:
        for a, b in zip(found, expected, strict=True):
            assert np.linalg.norm(b) > 0
            assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b)


@pytest.mark.slow
@pytest.mark.parametrize("attached", [True, False])
def test_adjoints_agree(toy, attached):
    from mi_nerfattack.vehicle.integrators import RK4

    loop, _ = toy.make_loop(RK4(), coarse=True)
    loop.sensor.set_offsets(OFFSET)
    assert_adjoints_agree(toy, loop, 4, attached)  # two segments of `Checkpointed`


def test_the_sensor_s_product_is_that_of_the_tape(toy, rng):
    import mitsuba as mi
    from helpers.tape import leaf, taped_image, tensor64

    loop, _ = toy.make_loop(coarse=True)
    sensor, state = loop.sensor, loop.initial(BOTH)
    sensor.set_offsets(OFFSET)
    seen = sensor.observe(state, 0)
    d_image = mi.TensorXf(rng.normal(size=seen.image.shape).astype(np.float32))
    sensor.start_gradient(poses=True)
    by_state = sensor.vjp(seen, state, d_image, True)
    found = [sensor.texture_gradients()[0].numpy(), sensor.offset_gradients(), by_state]
    leaves = [leaf(sensor.textures()[0]), leaf(tensor64(OFFSET)), leaf(state)]
    image = taped_image(sensor, leaves[2], 0, leaves[:1], leaves[1])
    np.testing.assert_allclose(image.numpy(), seen.image.numpy(), atol=1e-6)
    dr.backward(dr.sum(image.array * d_image.array))
    for a, b in zip(found, [np.array(dr.grad(x)) for x in leaves], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-5 * np.abs(b).max())


@pytest.mark.slow
def test_adjoints_agree_on_objects_in_front_of_each_other(toy):
    """Two objects that overlap in the image, each with its texture and offset."""
    from mi_nerfattack.fields import GridLayout
    from mi_nerfattack.render.camera.pose import Pose
    from mi_nerfattack.render.posed import PosedField
    from mi_nerfattack.rollout.field_sensor import FieldSensor
    from mi_nerfattack.vehicle.integrators import RK4

    loop, _ = toy.make_loop(RK4(), coarse=True)
    old = loop.sensor
    near = toy.blob(GridLayout(2, 6, 9), 0.8, 2.0, 0.2, 3)
    objects = [*old.objects, PosedField(near, Pose.upright((5.0, 0.3, 0.9), -0.4))]
    sensor = FieldSensor(old.scene, objects, old.camera, old.mount, stop=0.0)
    loop = replace(loop, sensor=sensor)
    seen = sensor.observe(loop.initial(INITIAL), 0).seen
    both = (seen.layers[1].opacity > 0.1) & (seen.layers[2].opacity > 0.1)
    assert dr.count(both)[0] > 3
    assert_adjoints_agree(toy, loop, 2, True)
