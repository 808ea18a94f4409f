"""The scene file of the demo, and the scene that its scenario writes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.rollout import SceneSensor
from mi_nerfattack.scenario import build_world, load_scenario
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.state import to_state

pytestmark = pytest.mark.usefixtures("variant")
SIZE = {"width": 100, "height": 33}


def scenario():
    """Return the demo's, of a small image with samples in the middle of intervals."""
    found, _ = load_scenario(bundled("demo.toml"))
    camera = found.camera.model_copy(update=SIZE)
    attack = found.attack.model_copy(update={"jitter": False})
    return found.model_copy(update={"camera": camera, "attack": attack})


def test_the_scenario_drives_in_the_scene_that_the_file_shows():
    """Image and gradient through the loop's camera, and the image of `mi.render`."""
    world = build_world(scenario(), None)
    scene = mi.load_file(str(bundled("demo.xml")), parallel=False, **SIZE)
    start = world.route.pose_at(0.0)
    sensor = SceneSensor(scene, world.place.mount, ["fields.hydrant.colour"])
    linear = mi.render(scene, spp=1).numpy()
    near = to_state(np.array([world.route.pose_at(16.0)]))
    weight = None
    found = []
    for one in (world.surrogate, sensor):
        seen = one.observe(to_state(start[None]), 0).linear.numpy().T
        error = seen.reshape(linear.shape) - linear
        assert np.sqrt((error**2).mean()) < 1e-5
        image = one.observe(near, 0)
        if weight is None:
            shape, rng = image.image.shape, np.random.default_rng(0)
            weight = mi.TensorXf(rng.normal(size=shape).astype(np.float32))
        one.start_gradient()
        one.vjp(image, near, weight, False)
        found.append(one.texture_gradients()[0].numpy().copy())
        one.stop_gradient()
    (expected, other), size = found, np.abs(found[0]).sum()
    assert size > 1
    assert np.abs(other - expected).sum() < 1e-3 * size
