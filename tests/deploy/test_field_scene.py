"""Scenes of fields as sensors: with other objects, from above, what is refused."""

from __future__ import annotations

import gc
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers import walled_scene as walled
from helpers.kernels import nothing_compiled

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.deploy.surrogate.scene import scene_sensor, showing
from mi_nerfattack.deploy.views.above import surrogate_above
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.rollout.adjoint import KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import CameraPath
from mi_nerfattack.rollout.objective import StageSum

pytestmark = pytest.mark.usefixtures("variant")

STATES = np.array([[0.0, 0.3, 0.05], [1.4, -0.2, -0.08]])


@pytest.fixture
def folder(variant: str, tmp_path: Path) -> Path:
    """Folder with the fields of the scenes."""
    walled.write_fields(tmp_path)
    return tmp_path


def sensor_of(description, attacked=("far", "near"), mount=toy.MOUNT):
    return scene_sensor(walled.load(description), mount, attacked)


def test_without_objects_it_shows_the_rest(folder):
    """Also where nothing but surfaces is left; equal to a scene that never had them."""
    description = walled.scene_dict(folder)
    integrator = description["integrator"]
    objects = {name: integrator.pop(name) for name in ("far", "near")}
    fog_alone = dict(integrator)
    del integrator["scene"]
    for parts, wanted in ((fog_alone, fog_alone), (integrator, integrator["behind"])):
        full = {**description, "integrator": {**parts, **objects}}
        sensor = showing(sensor_of(full), [])
        state = walled.close_loop(sensor).initial(STATES[:1])
        image = sensor.observe(state, 0).image.numpy()[0]
        bare = walled.rendered({**description, "integrator": wanted}, STATES[0])
        assert abs(image - linear_to_srgb_numpy(bare)).max() <= 1e-4
        assert image.std() > 0.01


def rollout(sensor, horizon, attached=False, adjoint=None):
    loop = walled.close_loop(sensor)
    cost = StageSum(toy.square_error)
    return Rollout(loop, cost, horizon, adjoint=adjoint or Replay(), attached=attached)


def difference(value, sensor, directions, h):
    """Differentiate a function of the sensor's textures along a direction."""
    base = [texture.numpy().copy() for texture in sensor.textures()]
    ends = []
    for s in (h, -h):
        moved = [b + s * d for b, d in zip(base, directions, strict=True)]
        sensor.set_textures([m.astype(np.float32) for m in moved])
        ends.append(value())
    sensor.set_textures(base)
    return (ends[0] - ends[1]) / (2 * h)


def along(gradients, directions):
    pairs = zip(gradients, directions, strict=True)
    return sum(float((gradient.numpy() * d).sum()) for gradient, d in pairs)


def test_detached_gradient_is_that_of_the_held_camera(folder, rng):
    """A wall between both objects, and a path tracer behind: noise is replayed."""
    behind = {"type": "path", "max_depth": 3}
    description = walled.scene_dict(folder, jitter=True, behind=behind)
    description["sensor"]["sampler"] = {"type": "independent", "sample_count": 2}
    description["sky"] = {"type": "constant", "radiance": 0.4}
    sensor = sensor_of(description)
    whole = rollout(sensor, 10, adjoint=KeptBackgrounds())
    initial = whole.loop.initial(STATES)
    drive = whole.run(initial)
    found = whole.gradient(drive).textures
    directions = [rng.normal(size=texture.shape) for texture in found]
    gc.collect()  # kernels depend on all BSDFs of the process
    whole.run(initial)
    replayed = replace(whole, adjoint=Replay())
    with nothing_compiled():
        again = replayed.run(initial)
    assert again.value == drive.value
    gradient = replayed.gradient(again).textures
    assert along(gradient, directions) == pytest.approx(along(found, directions), 1e-5)
    held = replace(replayed, camera_path=CameraPath(drive.trajectory.states))
    wanted = difference(lambda: held.run(initial).value, sensor, directions, 0.05)
    assert along(found, directions) == pytest.approx(wanted, 1e-3)


def test_attached_with_surfaces_is_refused(folder):
    sensor = sensor_of(walled.scene_dict(folder))
    whole = rollout(sensor, 1, attached=True)
    drive = whole.run(whole.loop.initial(STATES))
    with pytest.raises(
        InputError,
        match="attached: surfaces and a nested integrator",
    ):
        whole.gradient(drive)


def test_the_scene_shows_what_the_sensor_wears(folder):
    """Fields are shared, so that parameters count by their keys."""
    scene = walled.load(walled.scene_dict(folder))
    sensor = scene_sensor(scene, toy.MOUNT, ["far", "near"])
    parameters = mi.traverse(scene)
    for name, texture in zip(("far", "near"), sensor.textures(), strict=True):
        (key,) = (k for k in parameters.keys() if k.endswith(f"{name}.colour"))
        field = sensor.objects[name == "near"].field
        field.set_parameter("texture", 0 * texture)
        np.testing.assert_allclose(parameters[key].numpy(), 0.5, rtol=1e-6)
        parameters[key] = 0 * parameters[key] + 0.75
        parameters.update()
        now = sensor.textures()[name == "near"].numpy()[field.levels()[-1].vertices]
        np.testing.assert_allclose(now, np.log(3), rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"integrator": {"type": "path"}}, "PathIntegrator cannot be differentiated"),
        ({"integrator.far.type": "ngp_field"}, "no grid_field 'far'; .*: near, scene$"),
    ],
)
def test_what_is_refused(folder, change, message):
    description = walled.scene_dict(folder)
    for path, value in change.items():
        *way, last = path.split(".")
        inner = description
        for part in way:
            inner = inner[part]
        inner[last] = value
        if value == "ngp_field":
            inner["filename"] = str(folder / "sky.safetensors")
    with pytest.raises(InputError, match=message):
        sensor_of(description)


def test_from_above_an_object_is_where_it_stands(folder):
    """Another texture changes the pixels over its box alone, walls around or not."""
    sensor = sensor_of(walled.scene_dict(folder))
    posed = sensor.objects[1]
    middle = posed.placed.translation[:2]
    overhead = Overhead.covering(middle + [[-4.0, -3.0], [4.0, 3.0]], 0.0, 80)
    seen = []
    for colour in (-4.0, 4.0):
        texture = np.full((sensor.fields[1].n_vertices, 3), colour, np.float32)
        sensor.fields[1].set_parameter("texture", texture)
        seen.append(surrogate_above(sensor, overhead).astype(int))
    changed = np.argwhere(abs(seen[1] - seen[0]).max(-1) > 20)[:, ::-1] + 0.5
    low, high = posed.field.lower, posed.field.upper
    corners = np.array([[x[0], y[1], 0] for x in (low, high) for y in (low, high)])
    world = posed.placed.scale * corners @ posed.placed.rotation.T
    at = overhead.to_px(world[:, :2] + middle)
    assert len(changed) > 20
    assert (changed >= at.min(0) - 1).all() and (changed <= at.max(0) + 1).all()
    size = at.max(0) - at.min(0)
    assert (np.ptp(changed, axis=0) > 0.5 * size).all()
