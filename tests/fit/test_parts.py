"""What a fit consists of: rays, loss, cells, boxes and depth files."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.worlds.views import (
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
from mi_nerfattack.fit.loss import LossWeights, loss_and_cotangent
from mi_nerfattack.fit.rays import RayBank, RayBatch
from mi_nerfattack.fit.scores import compare
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.rays import March

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("alpha", [False, True])
def test_batch_holds_the_rays_and_values_of_images_of_several_sizes(alpha):
    images, depth = mixed_views(4, alpha)
    chosen = np.array([3, 2, 0])
    bank = RayBank(images, chosen, depth)
    batch = bank.batch(dr.arange(mi.UInt32, bank.count))
    rays, eyes, shown, known, places = [], [], [], [], []
    for place, i in enumerate(chosen):
        ray = world_rays(images.camera_of(i), images.camera_to_world[i]).reshape(-1, 3)
        rays.append(ray)
        eyes.append(np.broadcast_to(images.camera_to_world[i, :3, 3], ray.shape))
        shown.append(images.images[i].reshape(len(ray), -1))
        known.append(depth[i].ravel())
        places.append(np.full(len(ray), place))
    pixels = batch.colour.numpy().T
    if alpha:
        pixels = np.c_[pixels, batch.alpha.numpy()]
    for value, expected, atol in (
        (batch.direction.numpy().T, rays, 1e-6),
        (batch.origin.numpy().T, eyes, 1e-6),
        (255 * pixels, shown, 1e-4),
        (batch.depth.numpy(), known, 0),
        (batch.image.numpy(), places, 0),
    ):
        np.testing.assert_allclose(value, np.concatenate(expected), rtol=0, atol=atol)


def test_box_restricts_the_pixels_drawn():
    images, _ = sphere_views(4)
    small = (np.full(3, -0.05), np.full(3, 0.05))
    bank = RayBank(images, np.arange(4), box=small)
    batch = bank.batch(bank.draw(mi.PCG32(512)))
    closest = dr.norm(dr.cross(mi.Vector3f(batch.origin), batch.direction)).numpy()
    assert closest.max() <= 0.05 * np.sqrt(3) + 1e-6


def loss_reference(values: np.ndarray, ray: dict, weights: LossWeights) -> float:
    """Evaluate one ray's loss in float64; values: radiance, opacity, moment."""
    radiance, opacity, moment = values[:3], values[3], values[4]

    def penalty(error, delta):
        size = np.abs(error)
        return np.where(size < delta, size**2 / (2 * delta), size - delta / 2)

    shown = linear_to_srgb_numpy(radiance + (1 - opacity) * ray["background"])
    linear = ray["alpha"] * srgb_to_linear_numpy(ray["colour"])
    target = linear_to_srgb_numpy(linear + (1 - ray["alpha"]) * ray["background"])
    loss = penalty(shown - target, weights.huber).mean()
    hit = np.isfinite(ray["depth"])
    if hit:
        loss += weights.depth * penalty(moment / ray["depth"] - 1, 0.1)
    return float(loss + weights.opacity * penalty(opacity - hit, 0.02))


@pytest.mark.parametrize("depth", [2.0, np.inf])
@pytest.mark.parametrize("alpha", [0.0, 0.4, 1.0])
def test_cotangent_is_the_losss_derivative(depth, alpha):
    weights = LossWeights(0.05, 0.3, 0.2)
    sky, colour = np.array([0.1, 0.3, 0.6]), np.array([0.5, 0.2, 0.9])
    ray = {"background": sky, "colour": colour, "alpha": alpha, "depth": depth}
    values = np.array([0.3, 0.2, 0.15, 0.7, 1.75])
    primal = March(mi.Color3f(values[:3].tolist()), mi.Float(0.7), mi.Float(1.75))
    batch = RayBatch(
        mi.Point3f(0),
        mi.Vector3f(0, 0, 1),
        mi.Color3f(colour.tolist()),
        mi.Float(alpha),
        mi.Float(depth),
    )
    sky = mi.Color3f(sky.tolist())
    loss, _, cotangent = loss_and_cotangent(primal, sky, batch, weights, mi.Float(1))
    assert loss[0] == pytest.approx(loss_reference(values, ray, weights), rel=1e-3)
    terms = (cotangent.radiance.numpy(), cotangent.opacity, cotangent.moment)
    derivatives = np.concatenate([np.ravel(term) for term in terms])
    for i, step in enumerate(np.eye(5) * 1e-6):
        high, low = (loss_reference(values + s, ray, weights) for s in (step, -step))
        assert derivatives[i] == pytest.approx((high - low) / 2e-6, rel=2e-3, abs=1e-5)


def test_derivatives_where_depth_is_unknown_and_where_white_would_be_clipped():
    unknown = mi.Float([np.nan, np.nan, 2.0])
    primal = March(mi.Color3f(1), mi.Float([0.4, 0.9, 0.4]), mi.Float([0.7, 0.2, 0.7]))
    towards, colour = mi.Vector3f(0, 0, 1), mi.Color3f(0.5)
    batch = RayBatch(mi.Point3f(0), towards, colour, mi.Float(1), unknown)
    weights, black = LossWeights(depth=10.0, opacity=10.0), mi.Color3f(0)
    loss, _, cotangent = loss_and_cotangent(primal, black, batch, weights, mi.Float(1))
    assert np.isfinite(loss.numpy()).all()
    assert cotangent.radiance.numpy().min() > 0.1
    for values in (cotangent.opacity, cotangent.moment):
        assert (values.numpy() != 0).tolist() == [False, False, True]


def test_bounds_around_the_point_that_cameras_look_at():
    images, depth = sphere_views(12)
    for known in (None, np.full_like(depth, np.nan)):
        bounds = find_bounds(images, known)
        np.testing.assert_allclose(bounds, [[-3.2] * 3, [3.2] * 3], atol=1e-6)


def test_depth_and_given_bounds_win_over_points():
    images, depth = sphere_views(60)
    posed = replace(images, points=np.full((5, 3), 40.0))
    lower, upper = find_bounds(posed, depth)
    np.testing.assert_allclose(upper - lower, 2 * (RADIUS + 0.05), atol=0.02)
    bounds = find_bounds(posed, depth, (0, 0, 0, 1, 2, 3))
    np.testing.assert_array_equal(bounds, [[0, 0, 0], [1, 2, 3]])


def test_bounds_hold_a_step_of_the_march_behind_what_is_far():
    camera, pose = from_fov(8, 8, 1.0), look_at(np.zeros(3), [1.0, 0.0, 0.0])
    images = PosedImages(np.zeros((1, 8, 8, 3), np.uint8), pose[None], camera, ("a",))
    upper = find_bounds(images, np.full((1, 8, 8), 45, np.float32))[1]
    assert upper[0] == pytest.approx(45 + 45 / 128, abs=0.01)


def test_depth_is_read_at_the_images_size(tmp_path):
    depth = sphere_views(4)[1]
    images = write_folder(tmp_path, depth)
    np.testing.assert_array_equal(read_depth(tmp_path, images), depth)
    half = images.camera.resized(SIZE // 2, SIZE // 2)
    small = replace(images, images=images.images[:, ::2, ::2], camera=half)
    np.testing.assert_array_equal(read_depth(tmp_path, small), depth[:, 1::2, 1::2])


def test_masked_pixels_are_not_drawn():
    images, masks = masked()
    bank = RayBank(replace(images, masks=masks), np.array([0, 1]))
    drawn = bank.draw(mi.PCG32(4000, 1)).numpy()
    expected = np.ravel_multi_index((1, 4, np.arange(5, 8)), (2, *masks.shape[1:]))
    assert sorted(set(drawn.tolist())) == expected.tolist()


def masked() -> tuple[PosedImages, np.ndarray]:
    """Return three views, and masks that leave pixels of the second alone."""
    images, _ = sphere_views(3)
    masks = np.zeros(images.images.shape[:3], bool)
    masks[1, 4, 5:8] = True
    return images, masks


def parallel() -> PosedImages:
    """Two cameras that look in one direction."""
    poses = np.stack([look_at(np.array([x, 0.0, 1.0]), [x + 1, 0, 1]) for x in (0, 1)])
    pixels, lens = np.zeros((2, 4, 4, 3), np.uint8), from_fov(4, 4, 90.0)
    return PosedImages(pixels, poses, lens, ("a", "b"))


def bank(**changes) -> RayBank:
    images, masks = masked()
    if changes.pop("masks", None) is not None:
        images = replace(images, masks=masks)
    return RayBank(images, np.array([0, 2]), **changes)


def depth_file(change):
    def call(folder) -> None:
        depth = np.ascontiguousarray(change(sphere_views(4)[1]), np.float32)
        read_depth(folder, write_folder(folder, depth))

    return call


FAR = np.full(3, 50.0), np.full(3, 51.0)
test_refused = refusals(
    (lambda: bank(box=FAR), "bounds"),
    (lambda: bank(depth=sphere_views(2)[1]), "depth: shape"),
    (lambda: bank(masks=True), "masks: leave no pixel"),
    (lambda: find_bounds(parallel()), "camera poses: .*--bounds"),
    (lambda: find_bounds(parallel(), None, (0, 0, 0, 1, 0, 1)), "bounds: .*x0 y0"),
    (depth_file(lambda depth: depth[:3]), r"depth.safetensors: .*\(3, "),
    (depth_file(lambda depth: np.where(depth > 9, 0, depth)), "depth.safetensors: "),
)


def test_masked_pixels_are_not_scored():
    rng = np.random.default_rng(3)
    image = rng.random((24, 30, 3)).astype(np.float32)
    other = np.clip(image + 0.1, 0, 1)
    mask = np.ones((24, 30), bool)
    mask[14:] = False
    psnr, ssim = compare(image, other)
    wrong = np.where(mask[..., None], other, 1 - image)
    masked = compare(image, wrong, mask)
    assert masked[0] == pytest.approx(compare(image[:14], other[:14])[0])
    assert masked[1] > ssim - 0.02 and compare(image, wrong)[0] < psnr - 5
    assert compare(image, np.where(mask[..., None], image, 0), mask)[0] == np.inf
