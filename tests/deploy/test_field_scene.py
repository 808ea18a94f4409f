"""Scenes of fields with odd names, none, lights, lenses: right, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.reference.derivatives import key_of
from support.worlds import fields as small
from support.worlds import loops as toy
from support.worlds import loops as walled

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.deploy.surrogate.environment import measure, take_apart
from mi_nerfattack.deploy.surrogate.scene import field_sensor, scene_sensor, showing
from mi_nerfattack.deploy.views.above import surrogate_above
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.fields import GridLayout
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.adjoint import Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import CameraPath
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.vehicle.dynamics import to_state

pytestmark = pytest.mark.usefixtures("variant")
CAMERA = from_fov(toy.WIDTH, toy.HEIGHT, 70.0)
STATE = np.array([[0.0, 0.3, 0.05]])


@pytest.fixture
def folder(variant: str, tmp_path: Path) -> Path:
    walled.write_fields(tmp_path)
    return tmp_path


def objects() -> list[PosedField]:
    field = toy.blob(GridLayout(3, 6, 12), 1.0, 2.5, 0.08, 2)
    small.empty_border(field)
    return [PosedField(field, Pose.upright((7.0, 0.6, 1.0), 0.3))]


def fog() -> PosedField:
    return PosedField(toy.blob(GridLayout(2, 6, 9), 25.0, -2.0, 0.5, 1))


def image(sensor: Any) -> np.ndarray:
    return sensor.observe(to_state(STATE), 0).image.numpy()


def test_gradients_that_end_leave_what_was_set_meanwhile():
    """Textures, offsets and what kernels read of them."""
    items = objects()
    sensor = field_sensor(fog(), items, CAMERA, toy.MOUNT, names=["scene"])  # any name
    assert sensor.keys == ("fields.scene.colour",)
    before = image(sensor)
    sensor.start_gradient()
    sensor.stop_gradient()
    np.testing.assert_array_equal(image(sensor), before)
    black = [0 * texture - 5 for texture in sensor.textures()]
    sensor.start_gradient()
    sensor.set_textures(black)
    sensor.stop_gradient()
    dark = image(sensor)
    items[0].field.set_parameter("texture", black[0])
    np.testing.assert_array_equal(dark, image(sensor))
    offset = np.array([0.2, 0.1, 0, 0, 0, 0.3])
    sensor.start_gradient(sensor.pose_keys)
    sensor.objects[0].move(offset)
    sensor.start_gradient(sensor.pose_keys)
    sensor.stop_gradient()
    np.testing.assert_array_equal(sensor.objects[0].offset, offset)
    assert (image(sensor) != dark).any()


@pytest.mark.parametrize("composite", ["depth", "interleaved"])
def test_relit_objects_stay_so(folder, composite):
    """Also as new objects of the same field, in another place."""
    description = walled.scene_dict(folder, composite=composite)
    description["integrator"]["near"]["relit"] = True
    description["integrator"]["relit_samples"] = 4
    sensor = scene_sensor(walled.load(description), toy.MOUNT, ["near"])
    expected = image(sensor)
    again = [PosedField(item.field, item.pose) for item in sensor.objects]
    for shown in (sensor.objects, again):
        np.testing.assert_allclose(image(showing(sensor, shown)), expected, atol=1e-5)


def test_fields_of_emitters_are_no_objects(folder):
    """A scene for prb, whose field an emitter shows, can be driven in."""
    near = walled.volume(folder, "near", [3.5, -0.6, 1.0], 0.7)
    described = walled.scene_dict(folder, walls=False)
    box = mi.ScalarTransform4f().translate([3.5, -0.6, 1.0]).scale(0.7)
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    emitter = {"type": "field_emitter", "near": near}
    described["integrator"] = {"type": "prb"}
    described["lamp"] = {"type": "cube", "to_world": box, "bsdf": black}
    described["lamp"]["emitter"] = emitter
    scene = walled.load(described)
    with pytest.raises(InputError, match="PRBIntegrator; objects are shown by"):
        scene_sensor(scene, toy.MOUNT, ["near"])
    key = key_of(mi.traverse(scene), ".colour")
    sensor, state = SceneSensor(scene, toy.MOUNT, [key]), to_state(STATE)
    observation = sensor.observe(state, 0)
    distances = measure(sensor, observation, state)
    layers = take_apart(sensor, observation, distances.start)
    assert layers.objects == [] and dr.all(layers.behind.opacity == 1)
    assert 0 < np.isfinite(distances.far.numpy()).sum() < distances.far.numpy().size


THIN = {"type": "thinlens", "fov": 70.0, "aperture_radius": 0.1}
BALLS = {"type": "shapegroup", "ball": {"type": "sphere"}}
INSTANCE = {"type": "instance", "group": {"type": "ref", "id": "balls"}}


def walls(call, lens=None, crop=None, **entries):
    def make(folder):
        walled.write_fields(folder)
        described = walled.scene_dict(folder, *[lens] * bool(lens))
        described["sensor"]["film"].update(crop or {})
        return call(scene_sensor(walled.load(described | entries), toy.MOUNT, ["near"]))

    return make


def bricks():
    field = small.small_bricks(np.random.default_rng(0))
    field_sensor(PosedField(field), objects(), CAMERA).check_attached()


def lens_of(sensor):
    return sensor.intrinsics


def without(sensor):
    return showing(sensor, [])


def unknown(folder):
    walled.write_fields(folder)
    described = walled.scene_dict(folder)
    sky = {"type": "ngp_field", "filename": str(folder / "sky.safetensors")}
    described["integrator"]["far"].update(sky)
    sensor_of(described)


test_what_is_refused = refusals(
    (lambda: field_sensor(fog(), [], CAMERA, composite="foo"), "composite: 'foo'"),
    (lambda: field_sensor(fog(), [], CAMERA, stop=2.0), "stop: 2.0"),
    (bricks, "brick_field: "),
    (walls(lens_of, THIN), "aperture; .*perspective"),
    (walls(lens_of, crop={"crop_width": 5}), "crop_"),
    (walls(without, balls=BALLS, one=INSTANCE), "shapegroup"),
    (walls(lens_of, integrator={"type": "path"}), "PathIntegrator"),
    (unknown, "'far'; .*: near, scene$"),
)


STATES = np.array([[0.0, 0.3, 0.05], [1.4, -0.2, -0.08]])


def sensor_of(description, attacked=("far", "near")):
    return scene_sensor(walled.load(description), toy.MOUNT, attacked)


def test_without_objects_it_shows_the_rest(folder):
    """Also where nothing but surfaces is left; equal to a scene that never had them."""
    description = walled.scene_dict(folder)
    integrator = description["integrator"]
    objects = {name: integrator.pop(name) for name in ("far", "near")}
    fog_alone = dict(integrator)
    del integrator["scene"]
    for without_objects, expected in (
        (fog_alone, fog_alone),
        (integrator, integrator["behind"]),
    ):
        full = {**description, "integrator": {**without_objects, **objects}}
        sensor = showing(sensor_of(full), [])
        state = walled.close_loop(sensor).initial(STATES[:1])
        image = sensor.observe(state, 0).image.numpy()[0]
        bare = walled.rendered({**description, "integrator": expected}, STATES[0])
        assert abs(image - linear_to_srgb_numpy(bare)).max() <= 1e-4 < image.std()


def test_detached_gradient_is_that_of_the_held_camera(folder, rng):
    """A wall between both objects, and a path tracer behind: noise is replayed."""
    behind = {"type": "path", "max_depth": 3}
    description = walled.scene_dict(folder, jitter=True, behind=behind)
    description["sensor"]["sampler"] = {"type": "independent", "sample_count": 2}
    description["sky"] = {"type": "constant", "radiance": 0.4}
    sensor = sensor_of(description)
    loop = walled.close_loop(sensor)
    rollout = Rollout(loop, StageSum(toy.square_error), 10, adjoint=Replay())
    drive = rollout.run(loop.initial(STATES))
    held = replace(rollout, camera_path=CameraPath(drive.trajectory.states))
    gradients = [item.numpy() for item in rollout.gradient(drive).textures]
    base = [texture.numpy().copy() for texture in sensor.textures()]
    along = [rng.normal(size=item.shape) for item in base]

    def value(s):
        moved = [b + s * d for b, d in zip(base, along, strict=True)]
        sensor.set_textures([item.astype(np.float32) for item in moved])
        return held.run(loop.initial(STATES)).value

    expected = (value(0.05) - value(-0.05)) / 0.1
    derivative = sum((g * d).sum() for g, d in zip(gradients, along, strict=True))
    assert derivative == pytest.approx(expected, 1e-3)


def test_the_scene_shows_what_the_sensor_wears(folder):
    """Fields are shared, so that parameters count by their keys."""
    scene = walled.load(walled.scene_dict(folder))
    sensor, parameters = (
        scene_sensor(scene, toy.MOUNT, ["far", "near"]),
        mi.traverse(scene),
    )
    for name, texture in zip(("far", "near"), sensor.textures(), strict=True):
        key = key_of(parameters, f"{name}.colour")
        field = sensor.objects[name == "near"].field
        field.set_parameter("texture", 0 * texture)
        np.testing.assert_allclose(parameters[key].numpy(), 0.5, rtol=1e-6)
        parameters[key] = 0 * parameters[key] + 0.75
        parameters.update()
        now = sensor.textures()[name == "near"].numpy()[field.levels()[-1].vertices]
        np.testing.assert_allclose(now, np.log(3), rtol=1e-5)


def test_from_above_an_object_is_where_it_stands(folder):
    """Another texture changes the pixels over its box alone, walls around or not."""
    sensor = sensor_of(walled.scene_dict(folder))
    posed = sensor.objects[1]
    middle = posed.placed.translation[:2]
    overhead = Overhead.covering(middle + [[-4.0, -3.0], [4.0, 3.0]], 0.0, 80)
    images = []
    for colour in (-4.0, 4.0):
        texture = np.full((sensor.fields[1].n_vertices, 3), colour, np.float32)
        sensor.fields[1].set_parameter("texture", texture)
        images.append(surrogate_above(sensor, overhead).astype(int))
    changed = np.argwhere(abs(images[1] - images[0]).max(-1) > 20)[:, ::-1] + 0.5
    low, high = posed.field.lower, posed.field.upper
    corners = np.array([[x[0], y[1], 0] for x in (low, high) for y in (low, high)])
    world = posed.placed.scale * corners @ posed.placed.rotation.T
    at = overhead.to_px(world[:, :2] + middle)
    assert len(changed) > 20
    assert (changed >= at.min(0) - 1).all() and (changed <= at.max(0) + 1).all()
    size = at.max(0) - at.min(0)
    assert (np.ptp(changed, axis=0) > 0.5 * size).all()


def test_pictures_from_above_have_the_samples_of_the_sensor(folder):
    """Light from everywhere, seen by a nested path tracer: noise falls with them."""
    spreads = []
    for spp in (1, 64):
        description = walled.scene_dict(folder)
        description["sensor"]["sampler"] = {"type": "independent", "sample_count": spp}
        description["sky"] = {"type": "constant", "radiance": 0.5}
        ground = mi.ScalarTransform4f().translate([0, 0, -1]).scale(60)
        description["ground"] = {"type": "rectangle", "to_world": ground}
        overhead = Overhead.covering(np.array([[-9.0, -9], [-5, -7]]), 0.0, 40)
        picture = surrogate_above(sensor_of(description, ["near"]), overhead)
        spreads.append(picture.astype(float).std((0, 1)).mean())
    assert spreads[1] < 0.5 * spreads[0]


def test_grey_variants_are_refused(no_variant_left):
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(SetupError, match="llvm_ad_rgb"):
        field_sensor([], [], CAMERA)


@pytest.mark.parametrize("side", [2, 3])
def test_rays_of_a_pixel_are_those_of_a_larger_image(side):
    """Their mean in linear light; the texture's gradient spreads over them."""
    shown, scene = objects(), fog()
    large = from_fov(side * toy.WIDTH, side * toy.HEIGHT, 70.0)
    few = field_sensor(scene, shown, CAMERA, toy.MOUNT, spp=side**2)
    many = field_sensor(scene, shown, large, toy.MOUNT)
    state = to_state(STATE)
    actual, expected = (sensor.observe(state, 0) for sensor in (few, many))
    rows = expected.linear.numpy().T.reshape(toy.HEIGHT, side, toy.WIDTH, side, 3)
    mean = rows.mean((1, 3)).reshape(-1, 3)
    np.testing.assert_allclose(actual.linear.numpy().T, mean, atol=2e-6)

    def gradient(sensor, observation, d_linear):
        """Differentiate a sum of linear pixels by the texture."""
        linear = observation.linear.numpy().T
        slope = np.where(
            linear > 0.0031308, 1.055 / 2.4 * linear ** (1 / 2.4 - 1), 12.92
        )
        d_image = d_linear / slope.reshape(d_linear.shape)
        sensor.start_gradient()
        sensor.vjp(observation, state, mi.TensorXf(d_image[None].astype("f4")), False)
        by_texture = sensor.texture_gradients()[0].numpy()
        sensor.stop_gradient()
        return by_texture

    weights = np.random.default_rng(3).normal(size=(toy.HEIGHT, toy.WIDTH, 3))
    spread = weights.repeat(side, 0).repeat(side, 1) / side**2
    ours, theirs = gradient(few, actual, weights), gradient(many, expected, spread)
    assert np.abs(theirs).max() > 1e-3
    np.testing.assert_allclose(ours, theirs, atol=1e-5 * np.abs(theirs).max())


def test_rays_that_fill_no_square_are_refused():
    with pytest.raises(InputError, match="samples per pixel: .*1, 4, 9"):
        field_sensor(fog(), [], CAMERA, toy.MOUNT, spp=5)
