"""Small fits from end to end: grid, NGP, scores, pictures and commands."""

from __future__ import annotations

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.posed_folders import write_transforms
from helpers.sphere_views import (
    BOX,
    RADIUS,
    TINY_GRID,
    TINY_NGP,
    directions,
    mixed_views,
    sphere_views,
)

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.capture.posed_images import held_out
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField
from mi_nerfattack.fit import FitOptions, fit_grid, fit_ngp
from mi_nerfattack.fit.scores import compare, evaluate
from mi_nerfattack.fit.training import unpack
from mi_nerfattack.io import files
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


def grid_options(steps: int) -> FitOptions:
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
    """A sphere fitted with depth: its reports, kernels compiled by each, the result."""
    mi.set_variant("llvm_ad_rgb")
    images, depth = sphere_views(32)
    reports, compiled = [], []

    def progress(report):
        history = dr.kernel_history([dr.KernelType.JIT])
        compiled.append(sum(not entry["cache_hit"] for entry in history))
        reports.append(report)

    arguments = (*BOX, TINY_GRID, grid_options(150), depth)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        return reports, compiled, fit_grid(images, *arguments, progress=progress)


def test_grid_learns_a_sphere(fitted):
    reports, compiled, result = fitted
    assert result.steps == 150
    # at 25 steps the march, at 50 the first update of the occupancy
    assert compiled[2:] == [0] * 4
    assert [score.index for score in result.per_view] == held_out(32).tolist()
    assert result.psnr_heldout_db > 24
    assert result.psnr_heldout_db == pytest.approx(
        np.mean([score.psnr_db for score in result.per_view])
    )
    assert 0.5 < result.ssim_heldout <= 1
    assert reports[-1].loss < 0.3 * reports[0].loss
    assert tuple(reports) == result.history


@pytest.mark.slow
def test_grid_learns_from_images_of_several_sizes():
    images, depth = mixed_views(32)
    result = fit_grid(images, *BOX, TINY_GRID, grid_options(150), depth)
    assert result.psnr_heldout_db > 24


def test_fitted_sphere_is_solid_and_where_it_was(fitted):
    grid = fitted[-1].field
    eye = 1.6 * directions(50).T
    rays = Rays(mi.Point3f(np.float32(eye)), mi.Vector3f(np.float32(-eye / 1.6)))
    result = march(PosedField(grid), rays)
    assert np.median(result.opacity.numpy()) > 0.95
    assert abs(np.median(result.depth.numpy()) - (1.6 - RADIUS)) < 0.05


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
    ("name", "value"),
    [
        ("steps", 0),
        ("budget_minutes", 0.0),
        ("learning_rate", 1.0),
        ("epochs", 0.0),
        ("patience", 0),
        ("camera_rate", -1.0),
        ("seed", -1),
    ],
)
def test_options_out_of_range(name, value):
    with pytest.raises(InputError, match=name):
        FitOptions(**{name: value})


@pytest.mark.slow
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
        network="small",
        log2_table=10,
        max_resolution=32,
        occupancy=16,
        step_m=0.05,
        json=True,
    )
    assert command.run().tell(True) == 0
    summary = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert summary["steps"] == 30
    assert [view["index"] for view in summary["per_view"]] == [0, 8]
    assert (output.with_suffix(".report") / "report.html").is_file()
    field = load_field(output)
    again = np.mean([s.psnr_db for s in evaluate(field, images, [0, 8])])
    # half precision in the file
    assert again == pytest.approx(summary["psnr_heldout_db"], abs=0.1)


@pytest.mark.parametrize("name", ["field.pkl", "missing/field.safetensors"])
def test_command_checks_its_output_first(tmp_path, name):
    from mi_nerfattack.commands.asset import Asset

    with pytest.raises(InputError, match="must end in|make it first"):
        Asset(tmp_path / "no.glb", tmp_path / name).run()
