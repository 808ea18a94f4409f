"""Sensors look at the first three rows of a state, whatever follows them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import toy_loop as toy

from mi_nerfattack.vehicle.state import to_state

pytestmark = pytest.mark.usefixtures("variant")

# As many as make (n, 4) and (n, 3) the same number of values in some order.
POSES = np.array([[0.0, 0.0, 0.1], [0.5, -0.3, 0.0], [0.2, 0.4, -0.2]])
LONG = np.c_[POSES, [0.3, -0.2, 0.1]]


def field():
    return toy.make_loop()[0].sensor


def test_images_do_not_depend_on_further_rows():
    sensor = field()
    short = sensor.observe(to_state(POSES), 3).image.numpy()
    long = sensor.observe(to_state(LONG), 3).image.numpy()
    np.testing.assert_array_equal(long, short)
    assert np.ptp(short, axis=0).max() > 0.05  # the vehicles see different things


@pytest.mark.parametrize("attached", [False, True])
def test_derivatives_are_by_the_pose(attached, rng):
    sensor, found = field(), []
    weight = None
    for states in (POSES, LONG):
        state = to_state(states)
        seen = sensor.observe(state, 0)
        if weight is None:
            weight = mi.TensorXf(rng.normal(size=seen.image.shape).astype(np.float32))
        sensor.start_gradient()
        by_pose = sensor.vjp(seen, state, weight, attached)
        assert (by_pose is not None) == attached
        texture = sensor.texture_gradients()[0].numpy().copy()
        found.append((texture, None if by_pose is None else by_pose.numpy()[:3]))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-4, atol=1e-7)
    if attached:
        np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-4)
