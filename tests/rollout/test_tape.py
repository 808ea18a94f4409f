"""Adjoints against the whole drive on Dr.Jit's tape, in single precision."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from helpers.rollouts import ADJOINTS, INITIAL, OFFSET, gradient, make_rollout

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def toy(variant):
    from helpers import toy_loop

    return toy_loop


@pytest.mark.parametrize("attached", [True, False])
def test_gradient_by_the_pose_of_an_object_agrees_with_the_tape(toy, attached):
    loop, _ = toy.make_loop(coarse=True)
    loop.sensor.set_offsets(OFFSET)
    found, expected = (
        gradient(make_rollout(toy, loop, 4, attached, name), offsets=True).offsets
        for name in ("replay", "tape")
    )
    assert found.shape == (1, 6)
    floor = 1e-5 * np.abs(expected).max()  # of single precision
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=floor)


@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("adjoint", ADJOINTS[1:])
@pytest.mark.parametrize("horizon", [1, 2, 10])
def test_adjoints_agree(toy, horizon, adjoint, attached):
    from mi_nerfattack.vehicle.integrators import RK4

    loop, _ = toy.make_loop(RK4(), coarse=True)
    assert_agree(toy, loop, horizon, attached, adjoint)


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
    for adjoint in ADJOINTS[1:]:
        assert_agree(toy, loop, 2, True, adjoint)


def assert_agree(toy, loop, horizon, attached, adjoint):
    both = np.array([[0.0, 0.35, 0.02], [0.1, -0.2, -0.05]])
    replay = gradient(make_rollout(toy, loop, horizon, attached), both, offsets=True)
    expected = flat(replay)
    rollout = make_rollout(toy, loop, horizon, attached, adjoint)
    for a, b in zip(flat(gradient(rollout, both, offsets=True)), expected, strict=True):
        assert np.linalg.norm(b) > 0
        assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b)


@pytest.mark.slow
def test_replay_agrees_with_the_tape_over_a_long_drive(toy):
    loop, _ = toy.make_loop(coarse=True)
    replay = gradient(make_rollout(toy, loop, 100), offsets=True)
    expected = flat(replay)
    tape = gradient(make_rollout(toy, loop, 100, adjoint="tape"), offsets=True)
    for a, b in zip(flat(tape), expected, strict=True):
        assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b)


def flat(found):
    """Copy all parts of a gradient."""
    textures = [texture.numpy().astype(float) for texture in found.textures]
    return [*textures, np.array(found.initial), found.offsets, found.costates]
