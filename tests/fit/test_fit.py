"""Small fits from end to end: grid, NGP, scores, pictures and commands."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.faults.refusals import refusals
from support.files.objects import four_colours
from support.worlds.views import (
    BOX,
    RADIUS,
    TINY_GRID,
    TINY_NGP,
    directions,
    sphere_views,
    write_transforms,
)

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.capture.mesh.cube_faces import render_faces
from mi_nerfattack.capture.mesh.mesh import CUBE_FACES
from mi_nerfattack.capture.posed_images import held_out
from mi_nerfattack.commands.asset import AssetCube, AssetMesh
from mi_nerfattack.commands.fit import Fit, _gap_warnings
from mi_nerfattack.fields import GridField, load_field
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.fit import FitOptions, fit_grid, fit_ngp
from mi_nerfattack.fit.scores import FieldRenderer, compare, evaluate
from mi_nerfattack.fit.training import unpack
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")


def test_unpack_takes_packed_values_apart():
    grid = GridField(TINY_GRID, *BOX)
    packed = np.arange(4 * grid.n_vertices, dtype=np.float32)
    unpack(grid, mi.Float(packed))
    table = packed.reshape(-1, 4)
    np.testing.assert_array_equal(grid.parameters()["density"].numpy(), table[:, 0])
    np.testing.assert_array_equal(grid.texture.numpy(), table[:, 1:])
    np.testing.assert_array_equal(grid.packed.numpy(), packed)


@pytest.mark.parametrize(("apart_deg", "warned"), [(4, False), (40, True)])
def test_views_far_apart_are_told(apart_deg, warned):
    angles = np.radians(apart_deg) * np.arange(9)
    eyes = [[1.6 * np.cos(a), 1.6 * np.sin(a), 0] for a in angles]
    poses = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    images = replace(sphere_views(9)[0], camera_to_world=poses, points=points)
    lines = list(_gap_warnings(images))
    assert len(lines) == warned and all("40 degrees" in line for line in lines)


def test_scores():
    image = np.full((16, 16, 3), 0.5, np.float32)
    psnr, ssim = compare(image + np.float32(0.1), image)
    assert psnr == pytest.approx(20, abs=1e-4) and ssim < 1
    images, _ = sphere_views(2)
    images.images[...] = 0
    grid = GridField(TINY_GRID, *BOX)
    grid.set_parameter("density", np.full(grid.n_vertices, -50, np.float32))
    for score in evaluate(grid, images, [0, 1]):  # both are empty
        assert score.psnr_db == np.inf and score.ssim == pytest.approx(1)


OPTIONS = FitOptions(
    steps=150,
    batch_rays=512,
    learning_rate=0.05,
    occupancy_resolution=16,
    occupancy_start=30,
    occupancy_every=20,
)


@pytest.fixture(scope="module")
def fitted():
    """A sphere fitted with depth: its reports, kernels compiled by each, the result."""
    mi.set_variant("llvm_ad_rgb")
    images, depth = sphere_views(32)
    reports, compiled = [], []

    def progress(report):
        history = dr.kernel_history([dr.KernelType.JIT])
        compiled.append(sum(not entry["cache_hit"] for entry in history))
        reports.append(report)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        fit = fit_grid(images, *BOX, TINY_GRID, OPTIONS, depth, progress=progress)
    return reports, compiled, fit


def test_grid_learns_a_sphere(fitted):
    reports, compiled, result = fitted
    assert result.steps == 150
    # at 25 steps the march, at 50 the first update of the occupancy
    assert compiled[2:] == [0] * 4
    assert [score.index for score in result.per_view] == held_out(32).tolist()
    psnr = [score.psnr_db for score in result.per_view]
    assert result.psnr_heldout_db == pytest.approx(np.mean(psnr)) and min(psnr) > 20
    assert result.psnr_heldout_db > 24 and 0.5 < result.ssim_heldout <= 1
    assert reports[-1].loss < 0.3 * reports[0].loss
    assert tuple(reports) == result.history


def test_fitted_sphere_is_solid_and_where_it_was(fitted):
    eye = 1.6 * directions(50).T
    rays = Rays(mi.Point3f(np.float32(eye)), mi.Vector3f(np.float32(-eye / 1.6)))
    result = march(PosedField(fitted[-1].field), rays)
    assert np.median(result.opacity.numpy()) > 0.95
    assert abs(np.median(result.depth.numpy()) - (1.6 - RADIUS)) < 0.05


def test_ngp_learns_a_sphere_and_its_sky():
    images, depth = sphere_views(32, alpha=False)
    options, march = replace(OPTIONS, steps=200), {"step_m": 0.05, "cone": 0.0}
    result = fit_ngp(images, *BOX, TINY_NGP, options, depth, **march)
    assert result.psnr_heldout_db > 20
    sky = result.field.background(mi.Vector3f(0, 0.6, 0.8)).numpy()
    np.testing.assert_allclose(linear_to_srgb_numpy(sky), 128 / 255, atol=0.1)


def test_fit_ends_with_its_time_budget():
    images, depth = sphere_views(8)
    options = replace(OPTIONS, steps=100_000, budget_minutes=1 / 60, batch_rays=64)
    result = fit_grid(images, *BOX, TINY_GRID, options, depth)
    assert 0 < result.steps < 100_000


def asset(name):
    return lambda at: AssetMesh(source=at / "no.glb", output=at / name).run()


NO_ALPHA = partial(sphere_views, 8, alpha=False)
test_refused = refusals(
    (lambda: fit_grid(NO_ALPHA()[0], *BOX, TINY_GRID), "alpha"),
    (lambda: FitOptions(steps=0), "steps: 0"),
    (lambda: FitOptions(budget_minutes=0.0), "budget_minutes: 0.0"),
    (lambda: FitOptions(learning_rate=1.0), "learning_rate: 1.0"),
    (lambda: FitOptions(epochs=0.0), "epochs: 0.0"),
    (lambda: FitOptions(patience=0), "patience: 0"),
    (lambda: FitOptions(camera_rate=-1.0), "camera_rate: -1.0"),
    (lambda: FitOptions(seed=-1), "seed: -1"),
    (asset("field.pkl"), "field.pkl: .*safetensors"),
    (asset("missing/field.safetensors"), "missing.*make it first"),
)


@pytest.mark.slow
def test_command_fits_a_folder(tmp_path, capsys):
    images, depth = sphere_views(9, alpha=False)
    arguments = images.images, images.camera, images.camera_to_world
    write_transforms(tmp_path, *arguments, {"depth_file": "depth.safetensors"})
    files.write_safetensors(tmp_path / "depth.safetensors", {"depth": depth}, {})
    output = tmp_path / "field.safetensors"
    small = {"network": "small", "log2_table": 10, "max_resolution": 32}
    settings = {"steps": 30, "batch_rays": 256, "occupancy": 16, "step_m": 0.05}
    assert Fit(tmp_path, output, json=True, **small, **settings).run().tell(True) == 0
    summary = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert summary["steps"] == 30
    assert [view["index"] for view in summary["per_view"]] == [0, 8]
    assert (output.with_suffix(".report") / "report.html").is_file()
    scores = evaluate(load_field(output), images, [0, 8])
    # half precision in the file
    again = np.mean([score.psnr_db for score in scores])
    assert again == pytest.approx(summary["psnr_heldout_db"], abs=0.1)


@pytest.mark.slow
def test_duck_is_upright_metric_and_yellow(data_folder, tmp_path):
    """Its bill points to +x; 0.3 m high, 0.322 m long, 0.224 m wide, as its file."""
    duck, out = data_folder / "assets" / "Duck.glb", tmp_path / "duck.safetensors"
    settings = {"height_m": 0.3, "views": 16, "view_px": 96, "steps": 100}
    AssetMesh(source=duck, output=out, **settings).run()
    renderer = FieldRenderer(load_grid(out), over_white=True)
    camera, middle = from_fov(96, 96, 40.0), np.array([0, 0, 0.15])
    side = renderer.render(camera, look_at(middle - [0, 0.6, 0], middle))
    # at the middle of the duck a pixel is 0.6 m / fx wide
    rows, columns = np.nonzero(side.opacity > 0.5)
    pixel = 0.6 / camera.fx
    x, z = (columns - 47.5) * pixel, 0.15 + (47.5 - rows) * pixel
    extent = [x.min(), x.max(), z.min(), z.max()]
    assert extent == pytest.approx([-0.161, 0.161, 0.0, 0.3], abs=0.025)
    front = renderer.render(camera, look_at(middle + [0.6, 0, 0], middle))
    across = np.nonzero((front.opacity > 0.5).any(0))[0]
    assert (across[-1] - across[0]) * pixel == pytest.approx(0.224, abs=0.04)
    red, green, blue = body = side.image[70, 48]
    assert red > 0.7 and 0.5 < green < red and blue < 0.3
    # what reaches furthest to +x above the body is the bill: less green, orange
    tip = (side.opacity[rows, columns] > 0.95) & (z > 0.15) & (x > 0.12)
    assert tip.sum() > 20
    bill = side.image[rows[tip], columns[tip]].mean(0)
    assert bill[0] > 0.7 and bill[2] < 0.4
    assert bill[1] / bill[0] < 0.85 * body[1] / body[0]


@pytest.mark.slow
def test_pictures_of_a_cube_come_out_again(tmp_path):
    """In light from everywhere a convex object's radiance is its reflectance."""
    pictures = {}
    for i, name in enumerate(CUBE_FACES):
        pictures[name] = np.rot90(np.array(four_colours(64)), i % 4).copy()
        Image.fromarray(pictures[name]).save(tmp_path / f"{name}.png")
    out = tmp_path / "cube.safetensors"
    settings = {"ambient": 1.0, "views": 32, "view_px": 96, "steps": 120}
    AssetCube(output=out, edge_m=0.5, faces=tmp_path, **settings).run()
    faces = render_faces(load_grid(out), 128.0)
    np.testing.assert_allclose(faces.upper - faces.lower, 0.5)
    inner = np.ix_(np.r_[6:26, 38:58], np.r_[6:26, 38:58])
    for name, picture in pictures.items():
        face = faces.images[name].astype(float)
        assert face.shape == (64, 64, 4)
        if name != "nz":  # few views look at it from below
            assert np.abs(face[..., :3] - picture)[inner].mean() < 20, name
            assert face[inner][..., 3].mean() > 250
