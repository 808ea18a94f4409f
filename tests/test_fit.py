"""Fitting fields: rays, loss, cells and boxes against analysis; small fits whole."""

from __future__ import annotations

import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack import files
from mi_nerfattack.capture.evaluation import compare, comparison, evaluate
from mi_nerfattack.capture.fit import FitOptions, fit_grid, fit_ngp, unpack
from mi_nerfattack.capture.fit_cells import (
    cells_near_surfaces,
    depth_points,
    grid_shape,
)
from mi_nerfattack.capture.fit_inputs import find_bounds, read_depth
from mi_nerfattack.capture.fit_loss import LossWeights, huber, loss_and_cotangent
from mi_nerfattack.capture.fit_rays import RayBank, RayBatch
from mi_nerfattack.capture.frames import PosedImages, held_out, write_transforms
from mi_nerfattack.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout, NGPLayout
from mi_nerfattack.render.camera import from_fov, look_at
from mi_nerfattack.render.march import March

pytestmark = pytest.mark.usefixtures("variant")

SIZE = 24
RADIUS = 0.4
BOX = np.full(3, -0.5), np.full(3, 0.5)
TINY_GRID = GridLayout(4, 4, 16)
TINY_NGP = NGPLayout(4, 2, 10, 4, 32, 16)


def directions(count: int) -> np.ndarray:
    """Unit vectors (count, 3) all over the sphere."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    phi = 2.4 * np.arange(count)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def sphere_colour(normal: np.ndarray) -> np.ndarray:
    """Return sRGB that varies smoothly over a sphere."""
    return 0.5 + 0.3 * normal


def sphere_views(count: int = 16, alpha: bool = True) -> tuple[PosedImages, np.ndarray]:
    """Ray trace a coloured sphere, over nothing or over a grey sky."""
    camera = from_fov(SIZE, SIZE, 40.0)
    poses = np.stack([look_at(1.6 * d, np.zeros(3)) for d in directions(count)])
    images = np.zeros((count, SIZE, SIZE, 4), np.uint8)
    depth = np.full((count, SIZE, SIZE), np.inf, np.float32)
    for i, pose in enumerate(poses):
        ray = world_rays(camera, pose)
        eye = pose[:3, 3]
        b = ray @ eye
        root = b**2 - eye @ eye + RADIUS**2
        hit = root > 0
        t = -b[hit] - np.sqrt(root[hit])
        depth[i][hit] = t
        colour = sphere_colour((eye + t[:, None] * ray[hit]) / RADIUS)
        images[i][hit, :3] = np.round(255 * colour)
        images[i][hit, 3] = 255
    if not alpha:
        images[images[..., 3] == 0] = 128
        images = images[..., :3]
    names = tuple(f"view {i}" for i in range(count))
    return PosedImages(images, poses, camera, names), depth


def world_rays(camera, pose: np.ndarray) -> np.ndarray:
    """Unit directions (height, width, 3) of a camera, in NumPy."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1
    )
    world = local @ pose[:3, :3].T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


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
    return float(loss + weights.opacity * penalty(opacity - hit, 0.1))


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
    loss, _, cotangent = loss_and_cotangent(primal, background, batch, weights)
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
    cotangent = loss_and_cotangent(primal, mi.Color3f(0), batch, LossWeights())[2]
    assert cotangent.radiance.numpy().min() > 0.1


def test_cells_near_a_plane_are_those_it_crosses():
    camera = from_fov(64, 32, 90.0)
    pose = look_at(np.array([0.0, 0.0, 1.5]), np.array([1.0, 0.0, 1.3]))
    images = PosedImages(
        np.zeros((1, 32, 64, 3), np.uint8), pose[None], camera, ("plane",)
    )
    ray = world_rays(camera, pose)
    down = ray[..., 2] < 0
    depth = np.where(down, -1.5 / np.where(down, ray[..., 2], -1), np.inf)
    lower, upper = np.array([0.0, -5.0, -1.0]), np.array([20.0, 5.0, 3.0])
    shape = grid_shape(lower, upper, 40)
    assert shape == (40, 20, 20)
    points = depth_points(images, depth[None].astype(np.float32), [0], 0.01)
    cells = cells_near_surfaces(points, lower, upper, shape)
    assert set(np.nonzero(cells)[2]) <= {4, 5}  # the plane lies between these layers
    # Pixels lie d^2 / (h f) apart, 2 m at d = 10 m, points a quarter of that: no gap
    # up to there, although the cells are 0.5 m long.
    along = cells[:, 9:11].any(axis=(1, 2))
    assert along[4:19].all()


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


def test_bounds_of_parallel_cameras_are_asked_for():
    camera = from_fov(4, 4, 90.0)
    poses = np.stack([look_at(np.array([x, 0.0, 1.0]), [x + 1, 0, 1]) for x in (0, 1)])
    images = PosedImages(np.zeros((2, 4, 4, 3), np.uint8), poses, camera, ("a", "b"))
    with pytest.raises(InputError, match="--bounds"):
        find_bounds(images)


def write_folder(root: Path, depth: np.ndarray | None) -> PosedImages:
    """Write sphere views as a folder, with a depth file unless None."""
    images, _ = sphere_views(4)
    extra = None if depth is None else {"depth_file": "depth.safetensors"}
    write_transforms(root, images.images, images.camera, images.camera_to_world, extra)
    if depth is not None:
        files.write_safetensors(root / "depth.safetensors", {"depth": depth}, {})
    return images


def test_depth_is_read_at_the_images_size(tmp_path):
    depth = sphere_views(4)[1]
    images = write_folder(tmp_path, depth)
    np.testing.assert_array_equal(read_depth(tmp_path, images), depth)
    half = images.camera.resized(SIZE // 2, SIZE // 2)
    small = PosedImages(
        images.images[:, ::2, ::2], images.camera_to_world, half, images.names
    )
    np.testing.assert_array_equal(read_depth(tmp_path, small), depth[:, 1::2, 1::2])


def test_folder_without_depth(tmp_path):
    assert read_depth(tmp_path, write_folder(tmp_path, None)) is None


@pytest.mark.parametrize("fault", ["count", "nan"])
def test_depth_that_does_not_fit_is_an_error(tmp_path, fault):
    depth = sphere_views(4)[1]
    depth = depth[:3] if fault == "count" else np.where(depth > 9, np.nan, depth)
    images = write_folder(tmp_path, np.ascontiguousarray(depth, np.float32))
    with pytest.raises(InputError, match="depth.safetensors"):
        read_depth(tmp_path, images)


def test_unpack_takes_packed_values_apart():
    grid = GridField(TINY_GRID, *BOX)
    packed = np.arange(4 * grid.n_vertices, dtype=np.float32)
    unpack(grid, mi.Float(packed))
    table = packed.reshape(-1, 4)
    np.testing.assert_array_equal(grid.parameters()["density"].numpy(), table[:, 0])
    np.testing.assert_array_equal(grid.texture.numpy(), table[:, 1:])
    np.testing.assert_array_equal(grid.packed.numpy(), packed)


def test_empty_field_equals_empty_images():
    images, _ = sphere_views(2)
    images.images[...] = 0
    grid = GridField(TINY_GRID, *BOX)
    grid.set_parameter("density", np.full(grid.n_vertices, -50, np.float32))
    for score in evaluate(grid, images, [0, 1]):
        assert score.psnr_db == np.inf and score.ssim == pytest.approx(1)


def test_psnr_of_a_constant_error():
    image = np.full((16, 16, 3), 0.5, np.float32)
    psnr, ssim = compare(image + np.float32(0.1), image)
    assert psnr == pytest.approx(20, abs=1e-4)
    assert ssim < 1


def grid_options(steps: int = 60) -> FitOptions:
    return FitOptions(
        steps=steps,
        batch_rays=512,
        learning_rate=0.05,
        occupancy_resolution=16,
        occupancy_start=30,
        occupancy_every=20,
    )


@pytest.fixture(scope="module")
def fitted():
    """A sphere fitted with depth; the kernels that were compiled after ten steps."""
    mi.set_variant("llvm_ad_rgb")
    images, depth = sphere_views(32)
    reports = []
    return (
        images,
        reports,
        fit_grid(
            images, *BOX, TINY_GRID, grid_options(150), depth, progress=reports.append
        ),
    )


def test_grid_learns_a_sphere(fitted):
    images, reports, result = fitted
    assert result.steps == 150
    assert [score.index for score in result.per_view] == held_out(32).tolist()
    assert result.psnr_heldout_db > 24
    assert result.psnr_heldout_db == pytest.approx(
        np.mean([score.psnr_db for score in result.per_view])
    )
    assert 0.5 < result.ssim_heldout <= 1
    assert reports[-1].loss < 0.3 * reports[0].loss
    assert tuple(reports) == result.history


def test_fitted_sphere_is_solid_and_where_it_was(fitted):
    grid = fitted[2].field
    eye = 1.6 * directions(50).T
    from mi_nerfattack.render.march import PosedField, march

    result = march(
        PosedField(grid),
        mi.Point3f(np.float32(eye)),
        mi.Vector3f(np.float32(-eye / 1.6)),
        mi.Float(dr.inf),
        mi.Float(0.5),
        mi.Bool(True),
    )
    assert np.median(result.opacity.numpy()) > 0.95
    assert abs(np.median(result.depth.numpy()) - (1.6 - RADIUS)) < 0.05


def test_comparison_lays_out_the_worst_views(fitted):
    images, _, result = fitted
    picture = comparison(result.field, images, result.per_view, 2)
    assert picture.shape == (2 * SIZE, 3 * SIZE, 3)
    worst = min(result.per_view, key=lambda score: score.psnr_db)
    alpha = images.images[worst.index, ..., 3:] / 255
    wanted = images.images[worst.index, ..., :3] * alpha + 255 * (1 - alpha)
    np.testing.assert_allclose(picture[:SIZE, :SIZE], wanted, atol=1)


def test_nothing_is_compiled_after_the_first_steps():
    images, depth = sphere_views(16)
    compiled = []

    def watch(progress):
        history = dr.kernel_history([dr.KernelType.JIT])
        compiled.append(sum(not entry["cache_hit"] for entry in history))

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        fit_grid(images, *BOX, TINY_GRID, grid_options(100), depth, progress=watch)
    # at 25 steps the march, at 50 the first update of the occupancy
    assert compiled[2:] == [0, 0]


def test_ngp_learns_a_sphere_and_its_sky():
    images, depth = sphere_views(32, alpha=False)
    options = grid_options(200)
    result = fit_ngp(images, *BOX, TINY_NGP, options, depth, step_m=0.05, cone=0.0)
    assert result.psnr_heldout_db > 20
    sky = result.field.background(mi.Vector3f(0, 0.6, 0.8)).numpy()
    np.testing.assert_allclose(linear_to_srgb_numpy(sky), 128 / 255, atol=0.1)


def test_fit_ends_with_its_time_budget():
    images, depth = sphere_views(8)
    options = FitOptions(
        steps=100_000, budget_minutes=1 / 60, batch_rays=64, occupancy_resolution=8
    )
    result = fit_grid(images, *BOX, TINY_GRID, options, depth)
    assert 0 < result.steps < 100_000


def test_grid_needs_alpha():
    images, _ = sphere_views(8, alpha=False)
    with pytest.raises(InputError, match="alpha"):
        fit_grid(images, *BOX, TINY_GRID)


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"budget_minutes": 0.0}, {"learning_rate": 1.0}]
)
def test_options_out_of_range(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        FitOptions(**wrong)


def test_command_fits_a_folder(tmp_path, capsys):
    from mi_nerfattack.commands.fit import Fit
    from mi_nerfattack.fields import load_field

    images, depth = sphere_views(9, alpha=False)
    write_transforms(
        tmp_path,
        images.images,
        images.camera,
        images.camera_to_world,
        {"depth_file": "depth.safetensors"},
    )
    files.write_safetensors(tmp_path / "depth.safetensors", {"depth": depth}, {})
    output = tmp_path / "field.safetensors"
    command = Fit(
        tmp_path,
        output,
        steps=30,
        batch_rays=256,
        log2_table=10,
        max_resolution=32,
        occupancy=16,
        step_m=0.05,
        json=True,
    )
    assert command.run() == 0
    summary = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert summary["steps"] == 30
    assert [view["index"] for view in summary["per_view"]] == [0, 8]
    assert output.with_suffix(".png").is_file()
    field = load_field(output)
    again = np.mean([s.psnr_db for s in evaluate(field, images, [0, 8])])
    # half precision in the file
    assert again == pytest.approx(summary["psnr_heldout_db"], abs=0.1)


@pytest.mark.parametrize("name", ["field.pkl", "missing/field.safetensors"])
def test_command_checks_its_output_first(tmp_path, name):
    from mi_nerfattack.commands.asset import Asset

    with pytest.raises(InputError, match="field files end|make it first"):
        Asset(tmp_path / "no.glb", tmp_path / name).run()


def test_interrupted_command_leaves_nothing(tmp_path, monkeypatch):
    from mi_nerfattack.commands import fit_report
    from mi_nerfattack.commands.fit import Fit

    def interrupt(self, progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(fit_report.Bars, "fit", interrupt)
    folder = files.make_folder(tmp_path / "views")
    write_folder(folder, None)
    output = tmp_path / "field.safetensors"
    command = Fit(
        folder,
        output,
        steps=25,
        batch_rays=64,
        log2_table=8,
        max_resolution=32,
        occupancy=8,
        step_m=0.5,
    )
    with pytest.raises(KeyboardInterrupt):
        command.run()
    assert sorted(tmp_path.iterdir()) == [folder]
