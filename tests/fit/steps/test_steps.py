"""The gradients of a training step, and what they are made of."""

from __future__ import annotations

from dataclasses import replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.worlds import fields as small
from support.worlds.views import BOX, sphere_views

from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.fields import GridField, GridLayout, NGPField, NGPLayout, Occupancy
from mi_nerfattack.fields.cpu.networks import MLP, Networks
from mi_nerfattack.fit.batch import BatchSource
from mi_nerfattack.fit.cameras import EXPOSURE, POSES, CameraCorrections
from mi_nerfattack.fit.loss import LossWeights
from mi_nerfattack.fit.occupancy import RunningOccupancy, seen_cells
from mi_nerfattack.fit.rays import RayBank
from mi_nerfattack.fit.steps.march import MarchStep
from mi_nerfattack.fit.steps.points import PointStep
from mi_nerfattack.fit.steps.samples import (
    Samples,
    cotangents,
    list_samples,
    measure_spread,
)
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.walk import sample_count

pytestmark = pytest.mark.usefixtures("variant")

RAYS = 96
COUNT = 4  # images


def ngp(rng: np.random.Generator) -> NGPField:
    """A field with density, colours and a half-empty occupancy."""
    field = NGPField(NGPLayout(3, 2, 10, 4, 16, 16), *BOX, step_m=0.05, cone=0.0)
    table = rng.normal(size=field.encoding.n_params).astype(np.float32)
    field.set_parameter("table", mi.Float(table))
    field.density_scale = 6.0
    field.occupy(Occupancy(rng.random((6, 6, 6)) < 0.5))
    return field


def attach(field: NGPField, corrections: CameraCorrections) -> dict:
    """Make everything a leaf with gradient zero."""
    values = {**field.parameters(), **corrections.values}
    leaves = {name: type(value)(dr.detach(value)) for name, value in values.items()}
    for leaf in leaves.values():
        dr.enable_grad(leaf)
        dr.set_grad(leaf, dr.opaque(mi.Float, 0, dr.width(leaf)))
    for name in field.parameters():
        field.set_parameter(name, leaves[name])
    corrections.install(leaves)
    return leaves


def source(
    field: NGPField, learn: tuple[str, ...] = (), alpha: bool = False
) -> BatchSource:
    images, _ = sphere_views(COUNT, alpha=alpha)
    corrections = CameraCorrections(COUNT, learn)
    bank = RayBank(images, np.arange(COUNT), corrections=corrections)
    return BatchSource(bank, LossWeights(), field, sky=not alpha)


def random_numbers():
    random = mi.PCG32(RAYS, 3)
    dr.make_opaque(random)
    return random


def run(step, field: NGPField) -> tuple[dict, float]:
    leaves = attach(field, step.source.bank.corrections)
    score, _ = step(random_numbers(), dr.opaque(mi.UInt32, RAYS - 5))
    gradients = {name: dr.grad(leaf).numpy().copy() for name, leaf in leaves.items()}
    return gradients, score.loss[0] / score.rays[0]


@pytest.mark.parametrize("alpha", [False, True])
def test_wide_step_equals_the_march(rng, alpha):
    field = ngp(rng)
    batches = source(field, (EXPOSURE,) if not alpha else (), alpha)
    expected, loss = run(MarchStep(field, batches), field)
    gradients, again = run(PointStep(field, batches, 4096, 4096), field)
    assert again == pytest.approx(loss, rel=1e-5)
    for name, value in expected.items():
        scale = np.abs(value).max()
        assert scale > 0 or (alpha and name == "sky")
        np.testing.assert_allclose(
            gradients[name], value, atol=2e-5 * scale, err_msg=name
        )


def test_rays_beyond_the_room_for_samples_are_left_out(rng):
    field = ngp(rng)
    step = PointStep(field, source(field), 4096, 300)
    attach(field, step.source.bank.corrections)
    score, _ = step(random_numbers(), dr.opaque(mi.UInt32, RAYS))
    assert 0 < score.rays[0] < RAYS and score.visible[0] <= 300


def test_listed_samples_are_those_that_rays_cross():
    grid, origin, direction = small.half_occupied()
    far, jitter = dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Float, 0.5)
    rays = Rays(origin, direction, far, jitter)
    assert sample_count(PosedField(grid), rays).numpy().tolist() == [4, 2, 0]
    samples = list_samples(PosedField(grid), rays, 5)
    assert samples.fits.numpy().tolist() == [True, False, False]
    assert samples.count.numpy().tolist() == [4, 0, 0]
    np.testing.assert_allclose(samples.t.numpy()[:4], [1.125, 1.375, 1.625, 1.875])
    np.testing.assert_allclose(samples.width.numpy()[:4], 0.25)
    assert samples.ray.numpy()[:4].tolist() == [0] * 4


def test_gradient_by_the_poses_equals_that_of_the_march(rng):
    field = ngp(rng)
    # colours that do not depend on direction, which the wide step leaves out
    matrix = field.tensors()["colour_net.0"].copy()
    matrix[:, 16:] = 0
    tensors = {**field.tensors(), "colour_net.0": matrix}
    field = NGPField(field.layout, *BOX, tensors, field.occupancy, 0.05, 0.0)
    field.density_scale = 6.0
    batches = source(field, (POSES,))
    expected, _ = run(MarchStep(field, batches), field)
    gradients, _ = run(PointStep(field, batches, 4096, 4096), field)
    scale = np.abs(expected[POSES]).max()
    assert scale > 0
    np.testing.assert_allclose(gradients[POSES], expected[POSES], atol=1e-4 * scale)


@pytest.mark.parametrize("block", [1 << 12, 4])
def test_networks_against_central_differences(rng, monkeypatch, block):
    monkeypatch.setattr("mi_nerfattack.fields.cpu.networks.BLOCK", block)

    def layers(*sizes: int) -> MLP:
        pairs = zip(sizes[1:], sizes[:-1], strict=True)
        return MLP([rng.normal(size=pair) for pair in pairs])

    density, colour = layers(6, 8, 5), layers(5 + 3, 8, 8, 3)
    features, view = rng.normal(size=(10, 6)), rng.normal(size=(10, 3))
    slope = rng.normal(size=(10, 4))

    def objective() -> float:
        out, alone = np.empty((10, 4)), np.empty(10)
        Networks(density, colour).forward(features, view, out)
        Networks(density, colour).raw_density(features, alone)
        np.testing.assert_allclose(alone, out[:, 0])
        return float((out * slope).sum())

    nets, by_features = Networks(density, colour), np.empty((10, 6))
    nets.forward(features, view, np.empty((10, 4)))
    by_density, by_colour = nets.backward(slope, by_features)
    pairs = [(features, by_features)]
    pairs += zip(density.weights + colour.weights, by_density + by_colour, strict=True)
    for value, gradient in pairs:
        change, ends = rng.normal(size=value.shape), []
        for step in (1e-6, -2e-6, 1e-6):
            value += step * change
            ends.append(objective())
        central = (ends[0] - ends[1]) / 2e-6
        assert (gradient * change).sum() == pytest.approx(central, rel=1e-5)


def test_spread_and_its_derivative_against_all_pairs(rng):
    count, width, factor = 7, 0.1, 0.3
    depths = rng.uniform(0.1, 0.6, count)
    place = np.sort(rng.uniform(0, 1, count))

    def penalty(x: np.ndarray) -> float:
        behind = np.exp(-np.cumsum(x))
        weight = np.append(1, behind[:-1]) - behind
        pairs = np.abs(place[:, None] - place[None])
        return float(weight @ pairs @ weight + (weight**2).sum() * width / 3)

    x, t = mi.Float(depths), mi.Float(place)
    ray, widths = dr.zeros(mi.UInt32, count), dr.full(mi.Float, width, count)
    one = mi.UInt32([0]), mi.UInt32([count]), mi.Bool([True])
    samples = Samples(*one, ray, t, widths)
    spread = measure_spread(samples, x, t, mi.Float(width), mi.Float(factor))
    assert spread.penalty[0] == pytest.approx(penalty(depths), rel=1e-5)
    black, nothing = dr.zeros(mi.Color3f, count), March.zeros(1)
    by_depth, _ = cotangents(samples, x, black, nothing, nothing, spread)
    for k, step in enumerate(1e-5 * np.eye(count)):
        central = (penalty(depths + step) - penalty(depths - step)) / 2e-5
        assert by_depth[k] == pytest.approx(factor * central, rel=1e-4, abs=1e-6)


def test_gains_are_relative_to_their_mean():
    corrections = CameraCorrections(2, (EXPOSURE,))
    corrections.values = {EXPOSURE: mi.Float([1, 0, 2, 3, 0, 0])}
    gain = corrections.gain(mi.UInt32([0, 1])).numpy()
    np.testing.assert_allclose(gain, np.exp([[-1, 1], [0, 0], [1, -1]]), rtol=1e-5)
    np.testing.assert_allclose(corrections.gains(), gain.T, rtol=1e-5)


def test_moved_rays_are_those_of_the_corrected_poses(rng):
    images, _ = sphere_views(COUNT)
    value = 0.1 * rng.normal(size=6 * COUNT).astype(np.float32)
    corrections = CameraCorrections(COUNT, (POSES,))
    corrections.values = {POSES: mi.Float(value)}
    poses = corrections.poses(images.camera_to_world)
    moved = replace(images, camera_to_world=poses)
    index = mi.UInt32(rng.integers(COUNT * 24 * 24, size=50).tolist())
    batch = RayBank(images, np.arange(COUNT), corrections=corrections).batch(index)
    expected = RayBank(moved, np.arange(COUNT)).batch(index)
    for part in ("origin", "direction"):
        a, b = getattr(batch, part).numpy(), getattr(expected, part).numpy()
        np.testing.assert_allclose(a, b, atol=1e-5)


LOW, HIGH = np.full(3, -10.0), np.full(3, 10.0)


def views(lens: Camera, *looks, points=None) -> PosedImages:
    """Blank images from eyes to targets."""
    poses = np.stack(
        [look_at(np.array(a, float), np.array(b, float)) for a, b in looks]
    )
    pixels = np.zeros((len(poses), 16, 16, 3), np.uint8)
    names = tuple(map(str, range(len(poses))))
    return PosedImages(pixels, poses, lens, names, points=points)


def visibility(images: PosedImages, chosen, *places, edge: int = 40) -> list[bool]:
    """Return whether the cells at places of a box of 20 m are seen."""
    cells = seen_cells(images, np.array(chosen), LOW, HIGH, (edge,) * 3)
    scale = edge / 20
    return [bool(cells[tuple(int(scale * (v + 10)) for v in at)]) for at in places]


def test_cells_that_cameras_see():
    wide = from_fov(16, 16, 90.0)
    looks = ((0, 0, 0), (1, 0, 0)), ((5, -5, 0), (5, 0, 0))
    images = views(wide, *looks)
    ahead = (8, 0, 0), (8, 7, 7), (3, 0, 0), (-8, 0, 0), (2, 9, 0)
    assert visibility(images, [0], *ahead) == [True, True, True, False, False]
    both = (5, 0, 0), (5, -8, 0), (0.5, 9, 0)  # the second: by the second alone
    assert visibility(images, [0, 1], *both) == [True, False, False]
    points = np.random.default_rng(0).uniform([5, -2, -2], [7, 2, 2], (300, 3))
    begin = views(wide, *looks, points=points)  # at 5 m
    assert visibility(begin, [0], (3, 0, 0), (5, 0, 0), (3, 3, 3)) == [
        False,
        True,
        True,
    ]


def test_the_road_beneath_a_camera_is_seen_from_behind():
    road = np.random.default_rng(0).uniform([-9, -1, -1.8], [9, 1, -1.7], (4000, 3))
    looks = [((x, 0, 0), (x + 1, 0, 0)) for x in (0, -4, -8)]
    images = views(from_fov(16, 16, 90.0), *looks, points=road)
    beneath, before = (0.5, 0, -2), (1, 0, 0)  # of the first camera
    assert visibility(images, [0, 1, 2], beneath, before) == [True, False]


def test_cells_at_the_rim_of_a_distorted_image_are_seen():
    # barrel: the border, 1 / f from the axis, shows what lies farther out
    lens = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, k1=-0.2)
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    first = np.array([[[0.5, 0.5]]])  # pixel
    corner = cv2.undistortPoints(first, matrix, np.array(lens.distortion))[0, 0]
    x, y = 9 * corner  # right and down of the axis
    images = views(lens, ((0, 0, 0), (1, 0, 0)))
    assert visibility(images, [0], (9, -x, -y), edge=200) == [True]


def test_running_occupancy_finds_the_dense_half():
    grid = GridField(GridLayout(1, 9, 9), *BOX, density_scale=1.0, step_m=0.1)
    z = np.arange(grid.n_vertices) // 81  # x varies fastest
    raw = np.where(z >= 6, 4.0, -6.0).astype(np.float32)
    grid.set_parameter("density", raw)
    occupancy = RunningOccupancy(grid, np.ones((16, 16, 16), bool), 0)
    assert grid.occupancy.fraction == 1
    for step in range(3):
        occupancy.update(step)
    occupancy.install()
    cells = grid.occupancy.cells
    assert cells[:, :, 12:].all() and not cells[:, :, :9].any()
    again = RunningOccupancy(grid, np.ones((16, 16, 16), bool), 0)
    again.restore(occupancy.density, np.packbits(cells.ravel()))
    assert (grid.occupancy.cells == cells).all()
