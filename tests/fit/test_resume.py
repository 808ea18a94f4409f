"""Fits that are interrupted and go on, end early, or learn the cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.worlds.views import BOX, TINY_GRID, TINY_NGP, sphere_views

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.fit import FitOptions, FitResult, fit_grid, fit_ngp
from mi_nerfattack.fit import checkpoint as fit_checkpoint
from mi_nerfattack.fit.loss import LossWeights
from mi_nerfattack.fit.scores import FieldRenderer
from mi_nerfattack.fit.training import Training
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.conventions import opengl_to_opencv
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.report.pages.fit import write_cameras

pytestmark = pytest.mark.usefixtures("variant")


def options(**changes: object) -> FitOptions:
    settings = {
        "steps": 100,
        "batch_rays": 256,
        "samples": 1 << 12,
        "learning_rate": 0.05,
        "occupancy_resolution": 16,
        "occupancy_start": 20,
        "occupancy_every": 8,
    }
    return FitOptions(**settings | changes)


def ngp(checkpoint: Path | None = None, **keywords) -> FitResult:
    images, depth = keywords.pop("images", None) or sphere_views(8, alpha=False)
    settings = options(**keywords.pop("changes", {}))
    keywords |= {"step_m": 0.05, "cone": 0.0, "checkpoint": checkpoint}
    return fit_ngp(images, *BOX, TINY_NGP, settings, depth, **keywords)


def grid(checkpoint: Path | None = None, **keywords) -> FitResult:
    images, depth = sphere_views(8)
    settings = options(**keywords.pop("changes", {}))
    keywords |= {"checkpoint": checkpoint}
    return fit_grid(images, *BOX, TINY_GRID, settings, depth, **keywords)


def interrupt(*arguments, **keywords) -> None:
    raise KeyboardInterrupt


def stop_after(step: int, error: type[BaseException] = KeyboardInterrupt):
    def progress(at, *arguments) -> None:
        if at.step >= step:
            raise error

    return progress


@pytest.mark.parametrize("fit", [ngp, grid])
def test_resumed_fit_ends_where_the_whole_one_does(tmp_path, single_thread, fit):
    path = tmp_path / "fit.safetensors"
    uninterrupted = fit()
    with pytest.raises(KeyboardInterrupt):
        fit(path, progress=stop_after(50))
    assert path.is_file()
    result = fit(path)
    assert result.steps == uninterrupted.steps == 100
    assert [at.step for at in result.history] == [25, 50, 75, 100]
    for name, value in uninterrupted.field.tensors().items():
        np.testing.assert_array_equal(result.field.tensors()[name], value, name)


def test_a_longer_fit_goes_on_from_a_shorter_one(tmp_path):
    path = tmp_path / "fit.safetensors"
    with pytest.raises(KeyboardInterrupt):
        ngp(path, progress=stop_after(50))
    steps = []
    result = ngp(
        path, changes={"steps": 150}, progress=lambda at: steps.append(at.step)
    )
    assert result.steps == 150 and steps == [75, 100, 125, 150]


def test_killed_fit_goes_on_from_what_was_saved_on_the_way(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_checkpoint, "_EVERY_S", 0)
    monkeypatch.setattr(fit_checkpoint, "_MAX_SHARE", 1e9)
    path = tmp_path / "fit.safetensors"
    with pytest.raises(RuntimeError):  # nothing is saved at the end
        ngp(path, progress=stop_after(75, RuntimeError))
    result = ngp(path)
    assert [at.step for at in result.history] == [25, 50, 75, 100]
    uninterrupted = ngp()
    assert result.psnr_heldout_db == pytest.approx(
        uninterrupted.psnr_heldout_db, abs=0.5
    )
    times = [at.elapsed_s for at in result.history]
    assert times == sorted(times)


def test_unfinished_fit_is_not_overwritten(tmp_path):
    path = tmp_path / "fit.safetensors"
    with pytest.raises(KeyboardInterrupt):
        ngp(path, progress=stop_after(25))
    before = path.read_bytes()
    images, depth = sphere_views(8, alpha=False)
    for other in ({"changes": {"seed": 1}}, {"images": (images, depth * 1.001)}):
        with pytest.raises(InputError, match=r"fit\.safetensors: belongs .*\n  fit: "):
            ngp(path, **other)
    path.write_bytes(before[: len(before) // 2])
    with pytest.raises(InputError, match="damaged or truncated"):
        ngp(path)


def test_fit_ends_after_its_epochs_or_without_progress():
    slow = {"steps": 5000, "patience": 50, "learning_rate": 1e-6}
    assert 100 <= ngp(changes=slow).steps <= 150
    result = ngp(changes={"steps": None, "epochs": 2.0})
    pixels = 7 * 24 * 24
    rays = sum(25 * at.rays for at in result.history)
    assert 2 * pixels <= rays < 2 * pixels + 25 * 256


def test_fit_interrupted_at_once_is_resumed(tmp_path, monkeypatch):
    path = tmp_path / "fit.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(Training, "do_step", interrupt)
        with pytest.raises(KeyboardInterrupt):
            ngp(path)
    assert ngp(path).steps == 100


def test_fit_interrupted_while_it_is_scored_is_resumed(tmp_path, monkeypatch):
    path, reports = tmp_path / "fit.safetensors", []
    with monkeypatch.context() as patch:
        patch.setattr("mi_nerfattack.fit.fit.evaluate", interrupt)
        with pytest.raises(KeyboardInterrupt):
            ngp(path)
    result = ngp(path, progress=reports.append)
    assert result.steps == 100 and not reports
    assert np.isfinite(result.psnr_heldout_db)


def test_exposure_of_each_image_is_found():
    images, depth = sphere_views(48, alpha=False)
    # nothing but the sphere: each image could have a sky of its own
    middle = images.images[:, 6:18, 6:18].copy()
    camera = Camera(12, 12, images.camera.fx, images.camera.fy, 6, 6)
    linear = srgb_to_linear_numpy(middle[1::2].astype(np.float32) / 255)
    middle[1::2] = linear_to_uint8(0.5 * linear)
    wrong = replace(images, images=middle, camera=camera)
    near = np.ascontiguousarray(depth[:, 6:18, 6:18])
    changes = {"steps": 300, "exposure": True, "camera_rate": 1.0}
    result = ngp(images=(wrong, near), changes=changes)
    fitted = np.array([i for i in range(48) if i % 8])
    assert result.exposure.shape == (42, 3)
    bright, dark = (result.exposure[fitted % 2 == k].mean() for k in (0, 1))
    assert bright / dark == pytest.approx(2, rel=0.1)


def test_what_is_learned_of_cameras_is_written(tmp_path):
    images, _ = sphere_views(3, alpha=False)
    learned = np.arange(6.0).reshape(2, 3), images.camera_to_world[1:]
    nothing = FitResult(None, 0.0, 0.0, (), (), 0.0, 0)
    result = replace(nothing, exposure=learned[0], poses=learned[1])
    write_cameras(tmp_path / "cameras.json", result, images)
    frames = files.read_json(tmp_path / "cameras.json")["frames"]
    assert [frame["file_path"] for frame in frames] == ["view 1", "view 2"]
    assert frames[1]["exposure"] == [3, 4, 5]
    pose = opengl_to_opencv(np.array(frames[0]["transform_matrix"]))
    np.testing.assert_allclose(pose, images.camera_to_world[1], atol=1e-12)
    write_cameras(tmp_path / "none.json", nothing, images)
    assert not (tmp_path / "none.json").exists()


def test_a_sky_is_black_with_alpha_and_where_walls_take_its_place():
    inside, _ = sphere_views(16, alpha=False)  # grey behind the sphere: a wall
    walls = ngp(images=(inside, None), changes={"sky": False, "steps": 200})
    view = FieldRenderer(walls.field).render(inside.camera, inside.camera_to_world[0])
    assert np.median(view.opacity[10:14, 10:14]) > 0.9
    alpha = ngp(images=sphere_views(8), changes={"steps": 25})
    for result in (walls, alpha):
        sky = result.field.background(mi.Vector3f(0, 0.6, 0.8)).numpy()
        np.testing.assert_allclose(sky, 0, atol=1e-6)


def small_images() -> FitResult:
    images, depth = sphere_views(8, alpha=False)
    pixels = np.ascontiguousarray(images.images[:, 7:17, 7:17])
    camera = Camera(10, 10, images.camera.fx, images.camera.fy, 5, 5)
    return ngp(images=(replace(images, images=pixels, camera=camera), None))


def zero_depth() -> FitResult:
    images, depth = sphere_views(8, alpha=False)
    return ngp(images=(images, 0 * np.minimum(depth, 1)))


SPREAD = {"loss": LossWeights(spread=0.1)}
test_refused = refusals(
    (small_images, "images: 10 x 10 px"),
    (zero_depth, "depth"),
    (lambda: grid(changes=SPREAD), "spread"),
    (lambda: grid(changes={"exposure": True}), "exposure"),
)


def test_poses_are_corrected():
    images, _ = sphere_views(48)  # many right ones hold the field
    rng = np.random.default_rng(0)
    wrong = images.camera_to_world.copy()
    wrong[1:8, :3, 3] += rng.normal(0, 0.15, (7, 3))
    moved = replace(images, camera_to_world=wrong)
    changes = {"steps": 400, "poses": True, "camera_rate": 0.1}
    result = ngp(images=(moved, None), changes=changes)
    fitted = [i for i in range(48) if i % 8]

    def off_axis(poses: np.ndarray) -> float:
        """How far the optical axes miss the sphere's centre, on average."""
        eye, axis = poses[:, :3, 3], poses[:, :3, 2]
        return float(np.linalg.norm(np.cross(-eye, axis), axis=1)[:7].mean())

    assert off_axis(images.camera_to_world[fitted]) < 1e-6
    assert off_axis(result.poses) < 0.25 * off_axis(wrong[fitted])
