"""Products of the sensor of fields against Dr.Jit's tape of all samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.rollouts import OFFSET
from helpers.small_fields import empty_border
from helpers.tape import leaf, taped_image, tensor64

from mi_nerfattack.attack.freedom import offset_gradients
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import GridLayout
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField, move_all
from mi_nerfattack.rollout.sweep import Gradient

pytestmark = pytest.mark.usefixtures("variant")

BOTH = np.array([[0.0, 0.35, 0.02], [0.1, -0.2, -0.05]])


def test_products_of_the_sensor_are_those_of_the_tape(rng):
    """Two objects overlap in the image, each with its texture and offset."""
    loop, _ = toy.make_loop(coarse=True)
    old, state = loop.sensor, loop.initial(BOTH)
    near = toy.blob(GridLayout(2, 6, 9), 0.8, 2.0, 0.2, 3)
    objects = [*old.objects, PosedField(near, Pose.upright((5.0, 0.3, 0.9), -0.4))]
    empty_border(near)
    view = old.intrinsics, old.mount
    sensor = field_sensor(old.layers[0], objects, *view, stop=0.0)
    offsets = np.concatenate([OFFSET, -0.5 * OFFSET])
    move_all(sensor.objects, offsets)
    seen = sensor.observe(state, 0)
    layers = seen.kept.seen.layers
    both = (layers[1].opacity > 0.1) & (layers[2].opacity > 0.1)
    assert dr.count(both)[0] > 3
    d_image = mi.TensorXf(rng.normal(size=seen.image.shape).astype(np.float32))
    found = []
    for attached, poses in ((True, True), (False, True), (False, False)):
        sensor.start_gradient(sensor.pose_keys if poses else ())
        by_state = sensor.vjp(seen, state, d_image, attached)
        found += enumerate(np.array(x) for x in sensor.texture_gradients())
        if poses:
            by_pose = Gradient([], None, np.empty(0), None, sensor.gradients())
            found.append((2, offset_gradients(sensor, by_pose)))
        found += [(3, np.array(by_state))] if attached else []
        assert attached or by_state is None

    leaves = [leaf(x) for x in (*sensor.textures(), tensor64(offsets), state)]
    image = taped_image(sensor, leaves[3], leaves[:2], leaves[2])
    np.testing.assert_allclose(image.numpy(), seen.image.numpy(), atol=1e-6)
    dr.backward(dr.sum(image.array * d_image.array))
    for index, value in found:
        expected = np.array(dr.grad(leaves[index]))
        scale = np.abs(expected).max()
        np.testing.assert_allclose(value, expected, rtol=0, atol=2e-5 * scale)
