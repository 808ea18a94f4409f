"""What a fit consists of: rays, loss, cells, boxes and depth files."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.sphere_views import (
    RADIUS,
    SIZE,
    mixed_views,
    sphere_views,
    world_rays,
    write_folder,
)

from mi_nerfattack.backend.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.capture.inputs import find_bounds, read_depth
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.errors import InputError
from mi_nerfattack.fit.loss import LossWeights, huber, loss_and_cotangent
from mi_nerfattack.fit.rays import RayBank, RayBatch
from mi_nerfattack.fit.scores import compare
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.walk import sample_count

pytestmark = pytest.mark.usefixtures("variant")


def test_batch_holds_the_rays_and_values_of_its_pixels():
    images, depth = sphere_views(3)
    bank = RayBank(images, np.array([2, 1]), depth)
    row, column = 13, 7
    batch = bank.batch(mi.UInt32(SIZE * SIZE + row * SIZE + column))
    expected = world_rays(images.camera, images.camera_to_world[1])[row, column]
    np.testing.assert_allclose(batch.direction.numpy()[:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(
        batch.origin.numpy()[:, 0], images.camera_to_world[1, :3, 3], atol=1e-6
    )
    values = np.append(batch.colour.numpy()[:, 0], batch.alpha.numpy()[0])
    np.testing.assert_allclose(255 * values, images.images[1, row, column], atol=1e-4)
    assert batch.depth.numpy()[0] == depth[1, row, column]


def test_batch_of_images_of_several_sizes():
    images, depth = mixed_views(4, alpha=False)
    chosen = np.array([3, 2, 0])
    bank = RayBank(images, chosen, depth)
    assert bank.count == sum(images.images[i][..., 0].size for i in chosen)
    batch = bank.batch(dr.arange(mi.UInt32, bank.count))
    rays = [
        world_rays(images.camera_of(i), images.camera_to_world[i]).reshape(-1, 3)
        for i in chosen
    ]
    np.testing.assert_allclose(
        batch.direction.numpy().T, np.concatenate(rays), atol=1e-6
    )
    shown = np.concatenate([images.images[i].reshape(-1, 3) for i in chosen])
    np.testing.assert_allclose(255 * batch.colour.numpy().T, shown, atol=1e-4)
    known = np.concatenate([depth[i].ravel() for i in chosen])
    np.testing.assert_array_equal(batch.depth.numpy(), known)
    places = np.repeat(np.arange(3), [len(r) for r in rays])
    np.testing.assert_array_equal(batch.image.numpy(), places)
    with pytest.raises(InputError, match="depth: shape"):
        RayBank(images, chosen, depth[::-1])


def test_box_restricts_the_pixels_drawn():
    images, _ = sphere_views(4)
    small = (np.full(3, -0.05), np.full(3, 0.05))
    bank = RayBank(images, np.arange(4), box=small)
    batch = bank.batch(bank.draw(mi.PCG32(512)))
    closest = dr.norm(dr.cross(mi.Vector3f(batch.origin), batch.direction)).numpy()
    assert closest.max() <= 0.05 * np.sqrt(3) + 1e-6


def test_box_out_of_sight_is_an_error():
    images, _ = sphere_views(2)
    with pytest.raises(InputError, match="bounds"):
        RayBank(images, np.arange(1), box=(np.full(3, 50.0), np.full(3, 51.0)))


def test_depth_of_another_shape_is_an_error():
    images, depth = sphere_views(2)
    with pytest.raises(InputError, match="depth: shape"):
        RayBank(images, np.arange(2), depth[:1])


def test_huber_is_quadratic_then_linear():
    error = mi.Float([-0.05, 0.1, 0.5])
    expected = [0.05**2 / 0.2, 0.05, 0.45]
    np.testing.assert_allclose(huber(error, 0.1).numpy(), expected, rtol=1e-6)


def loss_reference(values: np.ndarray, ray: dict, weights: LossWeights) -> float:
    """Evaluate one ray's loss in float64; values: radiance, opacity, moment."""
    radiance, opacity, moment = values[:3], values[3], values[4]

    def penalty(error, delta):
        size = np.abs(error)
        return np.where(size < delta, size**2 / (2 * delta), size - delta / 2)

    shown = linear_to_srgb_numpy(radiance + (1 - opacity) * ray["background"])
    linear = ray["alpha"] * srgb_to_linear_numpy(ray["colour"])
    wanted = linear_to_srgb_numpy(linear + (1 - ray["alpha"]) * ray["background"])
    loss = penalty(shown - wanted, weights.huber).mean()
    hit = np.isfinite(ray["depth"])
    if hit:
        loss += weights.depth * penalty(moment / ray["depth"] - 1, 0.1)
    return float(loss + weights.opacity * penalty(opacity - hit, 0.02))


@pytest.mark.parametrize("depth", [2.0, np.inf])
@pytest.mark.parametrize("alpha", [0.0, 0.4, 1.0])
def test_cotangent_is_the_losss_derivative(depth, alpha):
    weights = LossWeights(0.05, 0.3, 0.2)
    ray = {
        "background": np.array([0.1, 0.3, 0.6]),
        "colour": np.array([0.5, 0.2, 0.9]),
        "alpha": alpha,
        "depth": depth,
    }
    values = np.array([0.3, 0.2, 0.15, 0.7, 1.75])
    zero = mi.Point3f(0)
    batch = RayBatch(
        zero,
        mi.Vector3f(0, 0, 1),
        mi.Color3f(ray["colour"].tolist()),
        mi.Float(alpha),
        mi.Float(depth),
    )
    primal = March(mi.Color3f(values[:3].tolist()), mi.Float(0.7), mi.Float(1.75))
    background = mi.Color3f(ray["background"].tolist())
    loss, _, cotangent = loss_and_cotangent(
        primal, background, batch, weights, mi.Float(1)
    )
    assert loss[0] == pytest.approx(loss_reference(values, ray, weights), rel=1e-3)
    parts = (cotangent.radiance.numpy(), cotangent.opacity, cotangent.moment)
    found = np.concatenate([np.ravel(part) for part in parts])
    for i, step in enumerate(np.eye(5) * 1e-6):
        high, low = (loss_reference(values + s, ray, weights) for s in (step, -step))
        assert found[i] == pytest.approx((high - low) / 2e-6, rel=2e-3, abs=1e-5)


def test_loss_of_white_before_white_still_has_a_derivative():
    batch = RayBatch(
        mi.Point3f(0), mi.Vector3f(0, 0, 1), mi.Color3f(0.5), mi.Float(1), None
    )
    primal = March(mi.Color3f(1), mi.Float(1), mi.Float(1))
    cotangent = loss_and_cotangent(
        primal, mi.Color3f(0), batch, LossWeights(), mi.Float(1)
    )[2]
    assert cotangent.radiance.numpy().min() > 0.1


def test_bounds_given_must_be_in_order():
    images, _ = sphere_views(2)
    lower, upper = find_bounds(images, None, (0, 0, 0, 1, 2, 3))
    assert lower.tolist() == [0, 0, 0] and upper.tolist() == [1, 2, 3]
    with pytest.raises(InputError, match="bounds"):
        find_bounds(images, None, (0, 0, 0, 1, 0, 1))


def test_bounds_around_the_point_that_cameras_look_at():
    images, _ = sphere_views(12)
    lower, upper = find_bounds(images)
    np.testing.assert_allclose(lower, -3.2, atol=1e-6)
    np.testing.assert_allclose(upper, 3.2, atol=1e-6)


def test_bounds_around_the_points_that_depth_shows():
    images, depth = sphere_views(60)
    lower, upper = find_bounds(images, depth)
    np.testing.assert_allclose(upper - lower, 2 * (RADIUS + 0.05), atol=0.02)


def test_bounds_hold_a_step_of_the_march_behind_what_is_far():
    camera, pose = from_fov(8, 8, 1.0), look_at(np.zeros(3), [1.0, 0.0, 0.0])
    images = PosedImages(np.zeros((1, 8, 8, 3), np.uint8), pose[None], camera, ("a",))
    upper = find_bounds(images, np.full((1, 8, 8), 45, np.float32))[1]
    assert upper[0] == pytest.approx(45 + 45 / 128, abs=0.01)


def test_bounds_where_no_depth_is_known_are_those_without_depth():
    images, depth = sphere_views(12)
    lower, upper = find_bounds(images, np.full_like(depth, np.nan))
    assert [lower.tolist(), upper.tolist()] == [b.tolist() for b in find_bounds(images)]


def test_bounds_of_parallel_cameras_are_asked_for():
    camera = from_fov(4, 4, 90.0)
    poses = np.stack([look_at(np.array([x, 0.0, 1.0]), [x + 1, 0, 1]) for x in (0, 1)])
    images = PosedImages(np.zeros((2, 4, 4, 3), np.uint8), poses, camera, ("a", "b"))
    with pytest.raises(InputError, match="--bounds"):
        find_bounds(images)


def test_depth_is_read_at_the_images_size(tmp_path):
    depth = sphere_views(4)[1]
    images = write_folder(tmp_path, depth)
    np.testing.assert_array_equal(read_depth(tmp_path, images), depth)
    half = images.camera.resized(SIZE // 2, SIZE // 2)
    small = replace(images, images=images.images[:, ::2, ::2], camera=half)
    np.testing.assert_array_equal(read_depth(tmp_path, small), depth[:, 1::2, 1::2])


@pytest.mark.parametrize("fault", ["count", "zero"])
def test_depth_that_does_not_fit_is_an_error(tmp_path, fault):
    depth = sphere_views(4)[1]
    depth = depth[:3] if fault == "count" else np.where(depth > 9, 0, depth)
    images = write_folder(tmp_path, np.ascontiguousarray(depth, np.float32))
    with pytest.raises(InputError, match="depth.safetensors"):
        read_depth(tmp_path, images)


def test_samples_are_counted_by_the_cells_that_rays_cross():
    grid, origin, direction = small.half_occupied()
    count = sample_count(PosedField(grid), Rays(origin, direction))
    assert count.numpy().tolist() == [4, 2, 0]


def test_masked_pixels_are_not_drawn():
    images, _ = sphere_views(3)
    masks = np.zeros(images.images.shape[:3], bool)
    masks[1, 4, 5:8] = True
    shape, indices = masks.shape[1:], np.array([0, 1])
    bank = RayBank(replace(images, masks=masks), indices)
    drawn = bank.draw(mi.PCG32(4000, 1)).numpy()
    wanted = np.ravel_multi_index((1, 4, np.arange(5, 8)), (2, *shape))
    assert sorted(set(drawn.tolist())) == wanted.tolist()
    with pytest.raises(InputError, match="masks: leave no pixel"):
        RayBank(replace(images, masks=masks), np.array([0, 2]))


def test_masked_pixels_are_not_scored():
    rng = np.random.default_rng(3)
    image = rng.random((24, 30, 3)).astype(np.float32)
    other = np.clip(image + 0.1, 0, 1)
    mask = np.ones((24, 30), bool)
    mask[14:] = False
    psnr, ssim = compare(image, other)
    wrong = other.copy()
    wrong[~mask] = 1 - image[~mask]
    masked = compare(image, wrong, mask)
    assert masked[0] == pytest.approx(compare(image[:14], other[:14])[0])
    assert masked[1] > ssim - 0.02 and compare(image, wrong)[0] < psnr - 5
    assert compare(image, np.where(mask[..., None], image, 0), mask)[0] == np.inf
