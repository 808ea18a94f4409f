"""The report of a fit: numbers that are known, pictures, and views without depth."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from support.pages.read import PageReader, page_text
from support.worlds.fields import homogeneous, sigmoid_to_linear, small_ngp
from support.worlds.views import SolidField, room_views, shell_cells, sphere_views

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.capture.posed_images import PosedImages, held_out
from mi_nerfattack.fields import Occupancy
from mi_nerfattack.fit.options import FitProgress, FitResult
from mi_nerfattack.fit.scores import (
    FieldRenderer,
    ViewScore,
    evaluate,
    reference,
    worst_views,
)
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.report.pages.fit import summary, write_fit_report
from mi_nerfattack.report.pages.verdict import judge, pooled_db, verdict

pytestmark = pytest.mark.usefixtures("variant")


def grey_views(shades: list[int]) -> PosedImages:
    """One flat image a shade, all from x = -3 towards a box of half-edge 1."""
    camera = from_fov(16, 12, 20.0)
    images = np.zeros((len(shades), 12, 16, 3), np.uint8)
    images[...] = np.array(shades)[:, None, None, None]
    poses = np.stack([look_at([-3.0, 0, 0], [0.0, 0, 0])] * len(shades))
    return PosedImages(images, poses, camera, tuple(f"grey {s}" for s in shades))


def solid_box():
    """A box that stops all light within a tenth of a millimetre, sRGB 0.5745."""
    field = homogeneous(1e5, 0.3)
    shown = float(linear_to_srgb_numpy(sigmoid_to_linear(np.array([0.3])))[0])
    return field, shown


def a_result(field, images: PosedImages, depth=None, **changes) -> FitResult:
    scores = evaluate(field, images, held_out(len(images)), depth)
    history = tuple(
        FitProgress(25 * i, 100, i / 4, 0.1 / i, 20.0 + i, 2.0 * i, 0.1)
        for i in range(1, 5)
    )
    values = {
        "field": field,
        "psnr_heldout_db": float(np.mean([s.psnr_db for s in scores])),
        "ssim_heldout": float(np.mean([s.ssim for s in scores])),
        "per_view": tuple(scores),
        "history": history,
        "wall_s": 12.0,
        "steps": 100,
    }
    return FitResult(**(values | changes))


def test_psnr_of_a_known_offset():
    field, shown = solid_box()
    shades = [100, 147, 250]
    scores = evaluate(field, grey_views(shades), range(3), keep=1)
    for score, shade in zip(scores, shades, strict=True):
        expected = -20 * np.log10(abs(shown - shade / 255))
        assert score.psnr_db == pytest.approx(expected, abs=0.01)
        assert score.hazy == 0
    assert [score.pictures is not None for score in scores] == [False, False, True]
    assert [score.index for score in worst_views(scores)] == [2]


def test_depth_and_haze_of_a_known_box():
    field, _ = solid_box()
    images = grey_views([0])
    view = FieldRenderer(field).render(images.camera, images.camera_to_world[0])
    x = (np.arange(16) + 0.5 - 8) / images.camera.fx
    y = (np.arange(12) + 0.5 - 6) / images.camera.fy
    to_wall = 2 * np.sqrt(1 + x**2 + y[:, None] ** 2)
    np.testing.assert_allclose(view.depth, to_wall, atol=0.011)  # a step
    thin = homogeneous(0.3)  # 1 - exp(-0.6) = 0.45 along the axis
    view = FieldRenderer(thin).render(images.camera, images.camera_to_world[0])
    assert view.hazy() == 1
    mask = np.zeros(view.opacity.shape, bool)
    mask[:, :8] = True
    opacity = np.where(mask, 1.0, 0.5)
    half = dataclasses.replace(view, opacity=opacity)
    assert (half.hazy(), half.hazy(mask)) == (0.5, 0)


def test_masked_pixels_are_out_of_haze_and_holes():
    """A known surface in thin fog, of which a mask takes all."""
    images = grey_views([0])
    renderer, pose = FieldRenderer(homogeneous(0.3)), images.camera_to_world[0]
    expected, depth = np.zeros((12, 16, 3), np.float32), np.full((12, 16), 3.0)
    depth[:, :8] = np.nan
    mask = np.zeros((12, 16), bool)
    mask[:, :8] = True
    score = renderer.score("a", images.camera, pose, expected, depth=depth, mask=mask)
    assert np.isnan(score.holes) and score.hazy == 1
    score = renderer.score("a", images.camera, pose, expected, depth=depth)
    assert score.holes == 1


@pytest.mark.parametrize(("layers", "is_whole"), [(1, False), (2, True)])
def test_rings_of_holes_in_far_walls_are_told(layers, is_whole):
    """Cells of 0.94 m in one layer, and steps of 1 m at 32 m."""
    images, depth = room_views(8)
    field = SolidField(0.2, 1 / 32)
    field.occupy(Occupancy(shell_cells((72, 72, 36), layers)))
    scores = evaluate(field, images, range(8), depth)
    (criterion,) = (item for item in judge(scores) if "known surfaces" in item.name)
    assert criterion.met == is_whole and (criterion.value > 0.01) != is_whole


def test_holes_are_counted_where_surfaces_are_known_and_in_the_box():
    field, _ = solid_box()
    images = grey_views([0])
    known = np.full((1, 12, 16), 2.5, np.float32)
    known[0, 0], known[0, 1] = np.nan, np.inf
    known[0, 2] = 7  # behind the box
    assert evaluate(field, images, [0], known)[0].holes == 0
    field.occupy(Occupancy(np.array([True, False]).reshape(1, 1, 2)))  # below z = 0
    assert evaluate(field, images, [0], known)[0].holes == pytest.approx(3 / 9)
    assert np.isnan(evaluate(field, images, [0], np.full_like(known, 7))[0].holes)
    assert np.isnan(evaluate(field, images, [0])[0].holes)


def test_images_with_alpha_lie_over_white():
    images, _ = sphere_views(1)
    alpha = images.images[0, ..., 3:] / 255
    expected = images.images[0, ..., :3] / 255 * alpha + (1 - alpha)
    np.testing.assert_allclose(reference(images, 0), expected, atol=1 / 255)


def test_report_folder(tmp_path):
    field, _ = solid_box()
    images = grey_views([140] * 24 + [20])
    depth = np.full((25, 12, 16), 2.3, np.float32)
    depth[:, :6] = np.inf
    result = a_result(field, images, depth)
    page = write_fit_report(tmp_path, result, images, "A <fit>")
    names = {"worst.png", "depth.png", "curve.png", "views.png"}
    written = {path.name for path in tmp_path.iterdir()}
    assert written == names | {"metrics.json", "report.html"}
    reader = PageReader(files.read_text(page))
    reader.check_alone()
    assert "A <fit>" in reader.text and len(reader.images) == len(names)
    assert not re.search(r"\b(nan|inf)\b", page_text(page))
    metrics = files.read_json(tmp_path / "metrics.json")
    assert metrics | summary(result) == metrics
    assert [view["index"] for view in metrics["per_view"]] == [0, 8, 16, 24]
    # the box's wall lies 2 m from the camera, 2 / cos away along a ray
    assert metrics["depth_error_median_m"] == pytest.approx(0.29, abs=0.02)
    assert metrics["good_enough"] is False
    assert metrics["settings"]["length_unit"] == "metre"


def test_report_of_views_that_show_nothing(tmp_path):
    """No surface, no depth, equal images: infinite numbers, and never NaN."""
    field = homogeneous()
    field.set_parameter("density", np.full(field.n_vertices, -200, np.float32))
    images = grey_views([0] * 9)
    result = a_result(field, images, np.full((9, 12, 16), np.inf), history=())
    assert result.psnr_heldout_db == np.inf
    page = write_fit_report(tmp_path, result, images, "empty")
    assert not re.search(r"\bnan\b", page_text(page))
    metrics = files.read_json(tmp_path / "metrics.json")
    assert metrics["psnr_heldout_db"] is metrics["depth_error_median_m"] is None
    images, _ = sphere_views(9, alpha=False)  # of an NGP, without depth
    write_fit_report(tmp_path, a_result(small_ngp(), images), images, "ngp")
    assert files.read_json(tmp_path / "metrics.json")["depth_error_median_m"] is None


def scores_of(
    psnr: list[float], hazy: float = 0.01, holes: float = np.nan
) -> list[ViewScore]:
    return [ViewScore(f"{i}", value, 0.9, hazy, holes) for i, value in enumerate(psnr)]


@pytest.mark.parametrize(
    ("psnr", "fitted", "hazy", "holes", "failed"),
    [
        ([30, 31, 29], 31, 0.01, np.nan, []),
        ([30, 31], 31, 0.01, np.nan, ["held-out views"]),
        ([23, 23, 23], 25, 0.01, np.nan, ["mean PSNR"]),
        ([30, 17, 30], 25, 0.01, np.nan, ["least PSNR"]),
        ([25, 25, 25], 31, 0.01, np.nan, ["fitted rays less"]),
        ([25, 25, 25], 26, 0.2, np.nan, ["opacity"]),
        ([30, 31, 29], 31, 0.01, 0.004, []),
        ([30, 31, 29], 31, 0.01, 0.006, ["known surfaces"]),
        ([np.inf] * 3, np.inf, 0.0, np.nan, []),
    ],
)
def test_verdict_names_what_is_not_met(psnr, fitted, hazy, holes, failed):
    criteria = judge(scores_of(psnr, hazy, holes), fitted)
    names = [item.name for item in criteria if not item.met]
    assert len(names) == len(failed)
    assert all(part in name for part, name in zip(failed, names, strict=True))
    assert all(name in verdict(criteria) for name in names)


def test_pooled_psnr_averages_squared_errors():
    assert pooled_db([20.0, 20.0]) == pytest.approx(20)
    expected = -10 * np.log10((1e-2 + 1e-4) / 2)
    assert pooled_db([20.0, 40.0]) == pytest.approx(expected)
    assert pooled_db([np.inf]) == np.inf
    assert len(judge(scores_of([30.0]))) == len(judge(scores_of([30.0]), 30.0)) - 1
