"""Scenes of fields with odd names, none, lights, lenses: right, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers import toy_loop as toy
from helpers import walled_scene as walled

from mi_nerfattack.attack.texture.statistics import seen_weights
from mi_nerfattack.deploy.surrogate.environment import measure, take_apart
from mi_nerfattack.deploy.surrogate.scene import field_sensor, scene_sensor, showing
from mi_nerfattack.deploy.views.above import surrogate_above
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.fields import GridLayout
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.vehicle.state import to_state

pytestmark = pytest.mark.usefixtures("variant")
CAMERA = from_fov(toy.WIDTH, toy.HEIGHT, 70.0)
STATE = np.array([[0.0, 0.3, 0.05]])


@pytest.fixture
def folder(variant: str, tmp_path: Path) -> Path:
    """Folder with the fields of the scenes."""
    walled.write_fields(tmp_path)
    return tmp_path


def objects(count: int = 1) -> list[PosedField]:
    """Return small fields side by side, 7 m ahead."""
    found = []
    for k in range(count):
        field = toy.blob(GridLayout(3, 6, 12), 1.0, 2.5, 0.08, 2 + k)
        small.empty_border(field)
        found.append(PosedField(field, Pose.upright((7.0, 0.6 - 2 * k, 1.0), 0.3)))
    return found


def fog() -> PosedField:
    return PosedField(toy.blob(GridLayout(2, 6, 9), 25.0, -2.0, 0.5, 1))


def image(sensor: Any) -> np.ndarray:
    return sensor.observe(to_state(STATE), 0).image.numpy()


@pytest.mark.parametrize(
    "name", ["scene", "jitter", "aovs", "type", "id", "stop", "composite"]
)
def test_an_object_may_have_any_name(name):
    items = objects()
    expected = image(field_sensor(fog(), items, CAMERA, toy.MOUNT))
    sensor = field_sensor(fog(), items, CAMERA, toy.MOUNT, names=[name])
    assert sensor.keys == (f"fields.{name}.colour",)
    np.testing.assert_allclose(image(sensor), expected, atol=1e-6)


def test_new_and_known_objects_are_all_shown():
    first, second, third = objects(3)
    sensor = field_sensor(fog(), [first, second], CAMERA, toy.MOUNT)
    other = showing(sensor, [second, third])
    assert other.objects == [second, third] and len(other.layers) == 3
    expected = field_sensor(fog(), [second, third], CAMERA, toy.MOUNT)
    np.testing.assert_allclose(image(other), image(expected), atol=1e-6)
    assert len(set(other.keys)) == 2


def test_a_scene_of_nothing_is_black():
    sensor = field_sensor([], [], CAMERA, toy.MOUNT)
    assert not image(sensor).any()
    alone = field_sensor([], objects(), CAMERA, toy.MOUNT)
    assert image(alone).any() and not image(showing(alone, [])).any()


def test_gradients_that_end_leave_what_was_set_meanwhile():
    """Textures, offsets and what kernels read of them."""
    items = objects()
    sensor = field_sensor(fog(), items, CAMERA, toy.MOUNT)
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


def test_weights_of_what_is_seen_change_nothing():
    sensor = field_sensor(fog(), objects(), CAMERA, toy.MOUNT)
    before = image(sensor)
    packed = sensor.fields[0].packed.numpy().copy()
    seen_weights(sensor, sensor.fields, [to_state(STATE)])
    sensor.start_gradient()
    sensor.stop_gradient()
    np.testing.assert_array_equal(sensor.fields[0].packed.numpy(), packed)
    np.testing.assert_array_equal(image(sensor), before)


@pytest.mark.parametrize("composite", ["depth", "interleaved"])
def test_relit_objects_stay_so(folder, composite):
    """Also as new objects of the same field, in another place."""
    description = walled.scene_dict(folder, composite=composite)
    description["integrator"]["near"]["relit"] = True
    description["integrator"]["relit_samples"] = 4
    sensor = scene_sensor(walled.load(description), toy.MOUNT, ["near"])
    seen = image(sensor)
    again = [PosedField(item.field, item.pose) for item in sensor.objects]
    for shown in (sensor.objects, again):
        np.testing.assert_allclose(image(showing(sensor, shown)), seen, atol=1e-5)


def test_pictures_from_above_have_the_samples_of_the_sensor(folder):
    """Light from everywhere, seen by a nested path tracer: noise falls with them."""
    spreads = []
    for spp in (1, 64):
        description = walled.scene_dict(folder)
        description["sensor"]["sampler"] = {"type": "independent", "sample_count": spp}
        description["sky"] = {"type": "constant", "radiance": 0.5}
        ground = mi.ScalarTransform4f().translate([0, 0, -1]).scale(60)
        description["ground"] = {"type": "rectangle", "to_world": ground}
        sensor = scene_sensor(walled.load(description), toy.MOUNT, ["near"])
        overhead = Overhead.covering(np.array([[-9.0, -9], [-5, -7]]), 0.0, 40)
        picture = surrogate_above(sensor, overhead).astype(float)
        spreads.append(picture.std((0, 1)).mean())
    assert spreads[1] < 0.5 * spreads[0]


def test_what_is_refused(folder):
    with pytest.raises(InputError, match="composite: 'foo'; allowed: "):
        field_sensor(fog(), [], CAMERA, composite="foo")
    with pytest.raises(InputError, match="stop: 2.0; allowed is"):
        field_sensor(fog(), [], CAMERA, stop=2.0)
    with pytest.raises(ValueError, match="names: 1 given for 2 objects"):
        field_sensor(fog(), objects(2), CAMERA, names=["a"])
    thin = {"type": "thinlens", "fov": 70.0, "aperture_radius": 0.1}
    lens = scene_sensor(
        walled.load(walled.scene_dict(folder, thin)), toy.MOUNT, ["near"]
    )
    with pytest.raises(InputError, match="has an aperture; use perspective"):
        _ = lens.intrinsics
    description = walled.scene_dict(folder)
    description["sensor"]["film"]["crop_width"] = 5
    cropped = scene_sensor(walled.load(description), toy.MOUNT, ["near"])
    with pytest.raises(InputError, match="remove crop_"):
        _ = cropped.intrinsics
    bricks = small.small_bricks(np.random.default_rng(0))
    sensor = field_sensor(PosedField(bricks), objects(), CAMERA)
    with pytest.raises(InputError, match="brick_field: .* keep the camera detached"):
        sensor.check_attached()


def test_shapes_that_cannot_be_shared_are_refused(folder):
    description = walled.scene_dict(folder)
    description["group"] = {"type": "shapegroup", "ball": {"type": "sphere"}}
    description["one"] = {
        "type": "instance",
        "group": {"type": "ref", "id": "group"},
    }
    sensor = scene_sensor(walled.load(description), toy.MOUNT, ["near"])
    with pytest.raises(InputError, match="instance of a shapegroup.*put meshes"):
        showing(sensor, [])


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
    (key,) = (k for k in mi.traverse(scene).keys() if k.endswith(".colour"))  # noqa: SIM118  not a dict
    sensor, state = SceneSensor(scene, toy.MOUNT, [key]), to_state(STATE)
    found = sensor.observe(state, 0)
    distances = measure(sensor, found, state)
    layers = take_apart(sensor, found, distances.start)
    assert layers.objects == [] and dr.all(layers.behind.opacity == 1)
    assert 0 < np.isfinite(distances.far.numpy()).sum() < distances.far.numpy().size


def test_grey_variants_are_refused(no_variant_left):
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(SetupError, match="MI_NERFATTACK_VARIANT=llvm_ad_rgb"):
        field_sensor([], [], replace(CAMERA))
