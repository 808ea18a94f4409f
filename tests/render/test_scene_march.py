"""Marches from a copy of a scene's parameters, beside the march of the field itself."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import nothing_compiled
from support.worlds.fields import homogeneous, small_ngp

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.fields import NGPField, NGPLayout, Occupancy, load_field
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.lens import generate_rays, mount_pose
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import STOP, march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain, Rays
from mi_nerfattack.render.scene_march import (
    FieldMarch,
    PackedMarch,
    scene_march,
)
from mi_nerfattack.render.walk import sample_count
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")


def random_rays(rng, count=300, spread=3.0) -> Rays:
    """Make rays from in and around [-1, 1]^3, towards it, with jitter and ends."""
    origin = rng.uniform(-spread, spread, (3, count))
    direction = rng.uniform(-0.8, 0.8, (3, count)) - origin
    direction /= np.linalg.norm(direction, axis=0)
    return Rays(
        mi.Point3f(origin.tolist()),
        mi.Vector3f(direction.tolist()),
        mi.Float(rng.uniform(0.5, 9.0, count).tolist()),
        mi.Float(rng.uniform(0, 0.99, count).tolist()),
        mi.Bool((rng.random(count) < 0.9).tolist()),
    )


def road_rays(x: float = -10.0) -> Rays:
    """Look along the road of the bundled intersection."""
    mount = CameraMount()
    place = mi.Float([x]), mi.Float([-1.75]), mi.Float([0.0])
    pose = mount_pose(place, mount.height_m, mount.forward_m, mount.pitch_deg)
    dr.eval(pose)
    origin, direction = generate_rays(from_fov(50, 17, 90.0), *pose, 1)
    return Rays(origin, direction)


def assert_same(posed: PosedField, rays: Rays, stop: float = STOP) -> None:
    actual = PackedMarch(posed, stop).march(rays)
    expected = march(posed, rays, stop)
    for name, atol in (("radiance", 2e-5), ("opacity", 2e-6), ("moment", 1e-4)):
        pair = [np.array(getattr(item, name)) for item in (actual, expected)]
        np.testing.assert_allclose(*pair, atol=atol, err_msg=name)


def test_octants_skipped_in_the_bundled_scene_are_hardly_seen():
    field = load_field(bundled("intersection/field.safetensors"))
    assert field.occupancy.octants is not None
    assert_same(PosedField(field), road_rays())
    colours, counts = [], []
    for occupancy in (field.occupancy, Occupancy(field.occupancy.cells)):
        field.occupancy = occupancy
        posed, views = PosedField(field), [road_rays(x) for x in (-30.0, -10.0, 10.0)]
        radiances = [PackedMarch(posed, STOP).march(rays).radiance for rays in views]
        colours.append(linear_to_srgb_numpy(np.stack([x.numpy() for x in radiances])))
        counts.append(np.mean([sample_count(posed, rays).numpy() for rays in views]))
    psnr = -10 * np.log10(np.mean((colours[0] - colours[1]) ** 2))
    assert 45 < psnr < 70
    assert counts[0] < 0.9 * counts[1]


@pytest.mark.parametrize(
    ("cone", "pose", "spread", "stop"),
    [
        (0.05, None, 3.0, STOP),
        (0.0, None, 3.0, 0.3),  # another place of termination would be seen
        (0.02, Pose.upright((0.3, -0.2, 0.1), 0.7, 1.6), 5.0, STOP),
        (0.0, None, 0.9, STOP),  # from inside
    ],
)
def test_it_is_the_march_of_a_small_field(rng, cone, pose, spread, stop):
    field = small_ngp(cone=cone)
    octants = rng.integers(0, 256, (6, 5, 4), np.uint8) | 2
    field.occupy(Occupancy(rng.random((6, 5, 4)) < 0.5, octants))
    posed, rays = PosedField(field, pose), random_rays(rng, spread=spread)
    assert 0.05 < float(dr.mean(march(posed, rays).opacity)[0]) < 0.95
    assert_same(posed, rays, stop)


def test_several_features_and_levels(rng):
    layout = NGPLayout(3, 4, 9, 6, 40, 24)
    field = NGPField(layout, -np.ones(3), np.array([1.0, 2.0, 1.5]), step_m=0.1)
    for name, value in field.parameters().items():
        fresh = rng.normal(0, 0.6, dr.width(value)).astype(np.float32)
        field.set_parameter(name, type(value)(fresh))
    assert_same(PosedField(field), random_rays(rng))


def test_empty_field_and_opaque_first_cell(rng):
    field = small_ngp()
    field.occupy(Occupancy(np.zeros((2, 2, 2), bool)))
    rays = random_rays(rng)
    integrals = PackedMarch(PosedField(field), STOP).march(rays)
    assert (
        not np.array(integrals.opacity).any() and not np.array(integrals.radiance).any()
    )
    field = small_ngp()
    field.density_scale = 1e9
    assert_same(PosedField(field), rays)


def test_gains_multiply_the_radiance(rng):
    posed, rays = PosedField(small_ngp()), random_rays(rng)
    gain = mi.Color3f(*(rng.uniform(0.5, 2, 300).tolist() for _ in range(3)))
    plain = PackedMarch(posed, STOP).march(rays)
    rays.gains = [Gain(gain)]
    for kind in (PackedMarch, FieldMarch):
        lit = kind(posed, STOP).march(rays)
        expected = np.array(plain.radiance) * np.array(gain)
        np.testing.assert_allclose(np.array(lit.radiance), expected, atol=2e-5)


def test_changed_parameters_are_followed(rng):
    """Also by a table that short words do not hold, and back."""
    field = small_ngp()
    posed, rays = PosedField(field), random_rays(rng)
    scene = PackedMarch(posed, STOP)
    table = field.encoding.data.numpy().astype(np.float16).astype(np.float32)
    weights = field.parameters()["colour_weights"].numpy().astype(np.float32)
    radiances = []
    for by_table, by_weight in ((1.0, 1.0), (0.7, 1.0), (0.5, -2.0), (1.0, 1.0)):
        field.set_parameter("table", mi.Float(np.float32(by_table) * table))
        field.set_parameter("colour_weights", mi.Float(np.float32(by_weight) * weights))
        actual, expected = scene.march(rays), march(posed, rays)
        radiances.append(np.array(actual.radiance))
        np.testing.assert_allclose(
            radiances[-1], np.array(expected.radiance), atol=2e-5
        )
    np.testing.assert_array_equal(radiances[0], radiances[3])
    assert all(
        np.abs(x - y).max() > 0.01
        for x, y in zip(radiances, radiances[1:], strict=False)
    )


def test_nothing_is_compiled_for_other_rays():
    posed = PosedField(load_field(bundled("intersection/field.safetensors")))
    scene = PackedMarch(posed, STOP)
    for x in (-10.0, -9.0):
        scene.march(road_rays(x))
    fresh = [road_rays(x) for x in (-3.0, 5.0)]
    dr.eval(fresh)
    with nothing_compiled():
        for rays in fresh:
            scene.march(rays)


def test_memory_does_not_grow_with_the_samples(rng):
    rays = random_rays(rng, 4096)
    peaks = []
    for step_m in (0.1, 0.005):
        field = small_ngp()
        field.step_m = step_m
        field.density_scale = 1e-3
        scene = PackedMarch(PosedField(field), STOP)
        scene.march(rays)
        gc.collect()  # the scene before is in a cycle
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        scene.march(rays)
        dr.sync_thread()
        peaks.append(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))
    assert peaks[1] <= 1.05 * peaks[0]


def test_the_choice_is_by_field(rng):
    assert isinstance(scene_march(PosedField(small_ngp()), STOP), PackedMarch)
    wide = NGPField(
        NGPLayout(levels=2, log2_table=8, width=128), -np.ones(3), np.ones(3)
    )
    assert isinstance(scene_march(PosedField(wide), STOP), FieldMarch)
    posed, rays = PosedField(homogeneous()), random_rays(rng)
    chosen = scene_march(posed, STOP)
    assert isinstance(chosen, FieldMarch)
    expected = np.array(march(posed, rays).radiance)
    radiance = np.array(chosen.march(rays).radiance)
    np.testing.assert_allclose(radiance, expected, atol=1e-6)
