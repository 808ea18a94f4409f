"""The gradients of a training step, and what they are made of."""

from __future__ import annotations

from dataclasses import replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.sphere_views import BOX, sphere_views

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
    found, again = run(PointStep(field, batches, 4096, 4096), field)
    assert again == pytest.approx(loss, rel=1e-5)
    for name, value in expected.items():
        scale = np.abs(value).max()
        assert scale > 0 or (alpha and name == "sky")
        np.testing.assert_allclose(found[name], value, atol=2e-5 * scale, err_msg=name)


def test_rays_beyond_the_room_for_samples_are_left_out(rng):
    field = ngp(rng)
    batches = source(field)
    step = PointStep(field, batches, 4096, 300)
    attach(field, batches.bank.corrections)
    score, _ = step(random_numbers(), dr.opaque(mi.UInt32, RAYS))
    assert 0 < score.rays[0] < RAYS
    assert score.kept[0] <= 300


def test_listed_samples_are_those_that_rays_cross(rng):
    grid, origin, direction = small.half_occupied()
    rays = Rays(
        origin, direction, dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Float, 0.5)
    )
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
    found, _ = run(PointStep(field, batches, 4096, 4096), field)
    scale = np.abs(expected[POSES]).max()
    assert scale > 0
    np.testing.assert_allclose(found[POSES], expected[POSES], atol=1e-4 * scale)


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
        out = np.empty((10, 4))
        Networks(density, colour).forward(features, view, out)
        alone = np.empty(10)
        Networks(density, colour).raw_density(features, alone)
        np.testing.assert_allclose(alone, out[:, 0])
        return float((out * slope).sum())

    nets, by_features = Networks(density, colour), np.empty((10, 6))
    nets.forward(features, view, np.empty((10, 4)))
    by_density, by_colour = nets.backward(slope, by_features)
    pairs = [(features, by_features)]
    pairs += zip(density.weights + colour.weights, by_density + by_colour, strict=True)
    for value, gradient in pairs:
        change = rng.normal(size=value.shape)
        value += 1e-6 * change
        high = objective()
        value -= 2e-6 * change
        low = objective()
        value += 1e-6 * change
        central = (high - low) / 2e-6
        assert (gradient * change).sum() == pytest.approx(central, rel=1e-5)


def test_spread_and_its_derivative_against_all_pairs(rng):
    count = 7
    depths = rng.uniform(0.1, 0.6, count)
    place = np.sort(rng.uniform(0, 1, count))
    width, factor = 0.1, 0.3

    def penalty(x: np.ndarray) -> float:
        behind = np.exp(-np.cumsum(x))
        weight = np.append(1, behind[:-1]) - behind
        pairs = np.abs(place[:, None] - place[None])
        return float(weight @ pairs @ weight + (weight**2).sum() * width / 3)

    samples = Samples(
        mi.UInt32([0]),
        mi.UInt32([count]),
        mi.Bool([True]),
        dr.zeros(mi.UInt32, count),
        mi.Float(place),
        dr.full(mi.Float, width, count),
    )
    found = measure_spread(
        samples, mi.Float(depths), mi.Float(place), mi.Float(width), mi.Float(factor)
    )
    assert found.penalty[0] == pytest.approx(penalty(depths), rel=1e-5)
    black = dr.zeros(mi.Color3f, count)
    nothing = March.zeros(1)
    by_depth, _ = cotangents(samples, mi.Float(depths), black, nothing, nothing, found)
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
    found = RayBank(images, np.arange(COUNT), corrections=corrections).batch(index)
    expected = RayBank(moved, np.arange(COUNT)).batch(index)
    for part in ("origin", "direction"):
        a, b = getattr(found, part).numpy(), getattr(expected, part).numpy()
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_intrinsics_of_single_images_make_their_rays():
    images, _ = sphere_views(2)
    wide = from_fov(24, 24, 80.0)
    own = replace(images, cameras=(images.camera, wide))
    bank = RayBank(own, np.arange(2))
    corner = bank.batch(mi.UInt32([0, 24 * 24])).direction.numpy().T
    axes = images.camera_to_world[:, :3, 2]
    for k, camera in enumerate((images.camera, wide)):
        tangent = np.sqrt(2) * (12 - 0.5) / camera.fx
        assert corner[k] @ axes[k] == pytest.approx(1 / np.hypot(1, tangent), rel=1e-5)


def test_cells_that_cameras_see():
    camera = from_fov(16, 16, 90.0)
    ahead = look_at(np.zeros(3), np.array([1.0, 0, 0]))
    across = look_at(np.array([5.0, -5.0, 0]), np.array([5.0, 0, 0]))
    images = PosedImages(
        np.zeros((2, 16, 16, 3), np.uint8),
        np.stack([ahead, across]),
        camera,
        ("ahead", "across"),
    )
    low, high, shape = np.full(3, -10.0), np.full(3, 10.0), (40, 40, 40)

    def at(cells: np.ndarray, x: float, y: float, z: float) -> bool:
        return bool(cells[tuple(int(2 * (v + 10)) for v in (x, y, z))])

    first = seen_cells(images, np.array([0]), low, high, shape)
    assert at(first, 8, 0, 0) and at(first, 8, 7, 7)
    assert not at(first, -8, 0, 0) and not at(first, 2, 9, 0)
    both = seen_cells(images, np.arange(2), low, high, shape)
    assert at(both, 5, 0, 0) and not at(both, 5, -8, 0)  # the second alone
    assert not at(both, 0.5, 9, 0)
    points = np.random.default_rng(0).uniform([5, -2, -2], [7, 2, 2], (300, 3))
    clear = seen_cells(replace(images, points=points), np.array([0]), low, high, shape)
    assert at(first, 3, 0, 0) and not at(clear, 3, 0, 0)  # points begin at 5 m
    assert at(clear, 5, 0, 0) and at(clear, 3, 3, 3)


def test_the_road_beneath_a_camera_is_seen_from_behind():
    eyes = [[x, 0.0, 0.0] for x in (0.0, -4.0, -8.0)]
    poses = np.stack([look_at(eye, np.add(eye, [1, 0, 0])) for eye in eyes])
    road = np.random.default_rng(0).uniform([-9, -1, -1.8], [9, 1, -1.7], (4000, 3))
    blank = np.zeros((3, 16, 16, 3), np.uint8)
    camera, names = from_fov(16, 16, 90.0), ("first", "second", "third")
    images = PosedImages(blank, poses, camera, names, points=road)
    low, high = np.full(3, -10.0), np.full(3, 10.0)
    seen = seen_cells(images, np.arange(3), low, high, (40, 40, 40))
    beneath, before = ((21, 20, 16), (22, 20, 20))  # of the first camera, half metres
    assert seen[beneath] and not seen[before]


def test_cells_at_the_rim_of_a_distorted_image_are_seen():
    # barrel: the border, 1 / f from the axis, shows what lies farther out
    lens = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, k1=-0.2)
    pose = look_at(np.zeros(3), np.array([1.0, 0, 0]))
    images = PosedImages(
        np.zeros((1, 16, 16, 3), np.uint8), pose[None], lens, ("ahead",)
    )
    low, high = np.full(3, -10.0), np.full(3, 10.0)
    seen = seen_cells(images, np.array([0]), low, high, (200, 200, 200))
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    first = np.array([[[0.5, 0.5]]])  # pixel
    corner = cv2.undistortPoints(first, matrix, np.array(lens.distortion))[0, 0]
    x, y = 9 * corner  # right and down of the axis
    assert seen[int(10 * 19), int(10 * (10 - x)), int(10 * (10 - y))]


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
