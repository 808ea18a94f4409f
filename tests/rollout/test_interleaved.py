"""The closed loop through the interleaved composite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.derivatives import central_difference
from helpers.rollouts import (
    INITIAL,
    along_texture,
    gradient,
    make_rollout,
    objective,
    texture_gradient,
    unit,
)

pytestmark = pytest.mark.usefixtures("variant")


def interleaved(toy):
    from mi_nerfattack.render.interleaved import InterleavedComposite
    from mi_nerfattack.rollout.field_sensor import FieldSensor

    loop, item = toy.make_loop()
    old = loop.sensor
    sensor = FieldSensor(
        old.scene, old.objects, old.camera, old.mount, composite=InterleavedComposite()
    )
    return replace(loop, sensor=sensor), item


def test_attached_gradient_through_the_interleaved_composite(toy):
    loop, item = interleaved(toy)
    rollout = make_rollout(toy, loop, 3, attached=True)
    found = texture_gradient(rollout)
    value = along_texture(toy, rollout, item, unit(found))
    expected = pytest.approx(np.linalg.norm(found), rel=1e-3)
    assert central_difference(value, 0.2) == expected


def test_gradient_by_pose_through_the_interleaved_composite(toy):
    loop, _ = interleaved(toy)
    rollout = make_rollout(toy, loop, 3, attached=True)
    found = gradient(rollout, offsets=True).offsets[0, 2]

    def value(s):
        loop.sensor.set_offsets(s * np.eye(6)[2:3])
        return objective(rollout)

    assert central_difference(value, 1e-3) == pytest.approx(found, rel=2e-2)


def test_the_interleaved_composite_has_no_ray_tangents(toy):
    loop, _ = interleaved(toy)
    rollout = make_rollout(toy, loop, 2, attached=True)
    evaluation = rollout.run(loop.initial(INITIAL))
    with pytest.raises(TypeError, match="keep the camera detached"):
        zero = [0 * texture for texture in loop.sensor.textures()]
        rollout.tangent(evaluation, zero, loop.initial(INITIAL))
