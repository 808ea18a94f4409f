"""Fits that are interrupted and go on, end early, or learn the cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.sphere_views import BOX, TINY_GRID, TINY_NGP, sphere_views, write_folder

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.fit import FitOptions, FitResult, fit_grid, fit_ngp
from mi_nerfattack.fit import checkpoint as fit_checkpoint
from mi_nerfattack.fit.loss import LossWeights
from mi_nerfattack.fit.scores import FieldRenderer
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera

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


def ngp(checkpoint: Path | None = None, **more) -> FitResult:
    images, depth = sphere_views(8, alpha=False)
    changes = more.pop("changes", {})
    return fit_ngp(
        images,
        *BOX,
        TINY_NGP,
        options(**changes),
        depth,
        step_m=0.05,
        cone=0.0,
        checkpoint=checkpoint,
        **more,
    )


def grid(checkpoint: Path | None = None, **more) -> FitResult:
    images, depth = sphere_views(8)
    more |= {"checkpoint": checkpoint}
    return fit_grid(images, *BOX, TINY_GRID, options(), depth, **more)


def interrupt(*arguments, **more) -> None:
    raise KeyboardInterrupt


def stop_after(step: int, error: type[BaseException] = KeyboardInterrupt):
    def progress(at, *more) -> None:
        if at.step >= step:
            raise error

    return progress


@pytest.mark.parametrize("fit", [ngp, grid])
def test_resumed_fit_ends_where_the_whole_one_does(tmp_path, single_thread, fit):
    path = tmp_path / "fit.safetensors"
    whole = fit()
    with pytest.raises(KeyboardInterrupt):
        fit(path, progress=stop_after(50))
    assert path.is_file()
    result = fit(path)
    assert result.steps == whole.steps == 100
    assert [at.step for at in result.history] == [25, 50, 75, 100]
    for name, value in whole.field.tensors().items():
        np.testing.assert_array_equal(result.field.tensors()[name], value, name)


def test_killed_fit_goes_on_from_what_was_saved_on_the_way(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_checkpoint, "_EVERY_S", 0)
    monkeypatch.setattr(fit_checkpoint, "_MAX_SHARE", 1e9)
    path = tmp_path / "fit.safetensors"
    with pytest.raises(RuntimeError):  # nothing is saved at the end
        ngp(path, progress=stop_after(75, RuntimeError))
    result = ngp(path)
    assert [at.step for at in result.history] == [25, 50, 75, 100]
    whole = ngp()
    assert result.psnr_heldout_db == pytest.approx(whole.psnr_heldout_db, abs=0.5)
    times = [at.elapsed_s for at in result.history]
    assert times == sorted(times)


def test_unfinished_fit_is_not_overwritten(tmp_path):
    path = tmp_path / "fit.safetensors"
    with pytest.raises(KeyboardInterrupt):
        ngp(path, progress=stop_after(25))
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"fit\.safetensors: belongs .*\n  fit: "):
        ngp(path, changes={"seed": 1})
    path.write_bytes(before[: len(before) // 2])
    with pytest.raises(InputError, match="damaged or truncated"):
        ngp(path)


def test_interrupted_command_is_resumed(tmp_path, monkeypatch, capsys):
    from mi_nerfattack.commands.fit import Fit
    from mi_nerfattack.commands.shared import progress

    folder = files.make_folder(tmp_path / "views")
    write_folder(folder, None)
    output = tmp_path / "field.safetensors"
    settings = {
        "steps": 50,
        "batch_rays": 64,
        "network": "small",
        "log2_table": 8,
        "max_resolution": 32,
        "occupancy": 8,
        "step_m": 0.5,
    }
    with monkeypatch.context() as patch:
        patch.setattr(progress.StageBars, "show", interrupt)
        with pytest.raises(KeyboardInterrupt):
            Fit(folder, output, **settings).run()
    kept = tmp_path / "field.checkpoint.safetensors"
    assert sorted(tmp_path.iterdir()) == [kept, folder]
    resumed = Fit(folder, output, **settings).run()
    assert resumed.tell(as_json=False) == 0
    assert output.is_file() and not kept.exists()
    assert "50 steps" in capsys.readouterr().out


def test_fit_without_progress_ends_early():
    result = ngp(changes={"steps": 5000, "patience": 50, "learning_rate": 1e-6})
    assert 100 <= result.steps <= 150


def test_fit_interrupted_at_once_is_resumed(tmp_path, monkeypatch):
    from mi_nerfattack.fit.training import Training

    path = tmp_path / "fit.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(Training, "do_step", stop_after(0))
        with pytest.raises(KeyboardInterrupt):
            ngp(path)
    assert ngp(path).steps == 100


def test_fit_interrupted_while_it_is_scored_is_resumed(tmp_path, monkeypatch):
    from mi_nerfattack.fit import fit as module

    path = tmp_path / "fit.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(module, "evaluate", interrupt)
        with pytest.raises(KeyboardInterrupt):
            ngp(path)
    reports = []
    result = ngp(path, progress=reports.append)
    assert result.steps == 100 and not reports
    assert np.isfinite(result.psnr_heldout_db)


def test_other_depth_is_refused(tmp_path):
    images, depth = sphere_views(8, alpha=False)
    path = tmp_path / "fit.safetensors"
    arguments = (*BOX, TINY_NGP, options())
    with pytest.raises(KeyboardInterrupt):
        fit_ngp(images, *arguments, depth, checkpoint=path, progress=stop_after(25))
    with pytest.raises(InputError, match=r"fit\.safetensors: belongs .*\n  fit: "):
        fit_ngp(images, *arguments, depth * 1.001, checkpoint=path)


def test_room_without_a_sky_becomes_solid():
    images, _ = sphere_views(16, alpha=False)
    # looking inwards at the sphere, the grey behind it must become a wall
    settings = options(sky=False, steps=200)
    result = fit_ngp(images, *BOX, TINY_NGP, settings, None, step_m=0.05, cone=0.0)
    sky = result.field.background(mi.Vector3f(0, 0.6, 0.8)).numpy()
    np.testing.assert_allclose(sky, 0, atol=1e-6)
    view = FieldRenderer(result.field).render(images.camera, images.camera_to_world[0])
    assert np.median(view.opacity[10:14, 10:14]) > 0.9


def test_images_too_small_for_their_score_are_refused():
    images, depth = sphere_views(8, alpha=False)
    small = replace(
        images,
        images=np.ascontiguousarray(images.images[:, 7:17, 7:17]),
        camera=Camera(10, 10, images.camera.fx, images.camera.fy, 5, 5),
    )
    with pytest.raises(InputError, match="images: 10 x 10 px"):
        fit_ngp(small, *BOX, TINY_NGP, options())
    with pytest.raises(InputError, match="depth"):
        fit_ngp(images, *BOX, TINY_NGP, options(), 0 * np.minimum(depth, 1))


def test_epochs_end_a_fit():
    result = ngp(changes={"steps": None, "epochs": 2.0})
    pixels = 7 * 24 * 24
    rays = sum(25 * at.rays for at in result.history)
    assert 2 * pixels <= rays < 2 * pixels + 25 * 256


def test_exposure_of_each_image_is_found():
    images, depth = sphere_views(48, alpha=False)
    # nothing but the sphere: each image could have a sky of its own
    middle = images.images[:, 6:18, 6:18].copy()
    camera = Camera(12, 12, images.camera.fx, images.camera.fy, 6, 6)
    linear = srgb_to_linear_numpy(middle[1::2].astype(np.float32) / 255)
    middle[1::2] = linear_to_uint8(0.5 * linear)
    wrong = replace(images, images=middle, camera=camera)
    settings = options(steps=300, exposure=True, camera_rate=1.0)
    near = np.ascontiguousarray(depth[:, 6:18, 6:18])
    result = fit_ngp(wrong, *BOX, TINY_NGP, settings, near, step_m=0.05, cone=0.0)
    fitted = np.array([i for i in range(48) if i % 8])
    assert result.exposure.shape == (42, 3)
    bright, dark = (result.exposure[fitted % 2 == k].mean() for k in (0, 1))
    ratio = bright / dark
    assert ratio == pytest.approx(2, rel=0.1)


def test_what_is_learned_of_cameras_is_written(tmp_path):
    from mi_nerfattack.render.camera.conventions import opengl_to_opencv
    from mi_nerfattack.report.pages.fit import write_cameras

    images, _ = sphere_views(3, alpha=False)
    learned = np.arange(6.0).reshape(2, 3), images.camera_to_world[1:]
    result = FitResult(None, 0.0, 0.0, (), (), 0.0, 0, *learned)
    write_cameras(tmp_path / "cameras.json", result, images)
    frames = files.read_json(tmp_path / "cameras.json")["frames"]
    assert [frame["file_path"] for frame in frames] == ["view 1", "view 2"]
    assert frames[1]["exposure"] == [3, 4, 5]
    pose = opengl_to_opencv(np.array(frames[0]["transform_matrix"]))
    np.testing.assert_allclose(pose, images.camera_to_world[1], atol=1e-12)
    write_cameras(
        tmp_path / "none.json", FitResult(None, 0.0, 0.0, (), (), 0.0, 0), images
    )
    assert not (tmp_path / "none.json").exists()


def test_images_with_alpha_leave_a_black_sky():
    images, depth = sphere_views(8)
    result = fit_ngp(
        images, *BOX, TINY_NGP, options(steps=25), depth, step_m=0.05, cone=0.0
    )
    sky = result.field.background(mi.Vector3f(0, 0.6, 0.8)).numpy()
    np.testing.assert_allclose(sky, 0, atol=1e-6)


def test_spread_is_refused_where_it_would_not_count():
    images, depth = sphere_views(8)
    settings = options(loss=LossWeights(spread=0.1))
    with pytest.raises(InputError, match="spread"):
        fit_grid(images, *BOX, TINY_GRID, settings, depth)


def test_exposure_needs_images_without_alpha():
    images, depth = sphere_views(8)
    with pytest.raises(InputError, match="exposure"):
        fit_grid(images, *BOX, TINY_GRID, options(exposure=True), depth)


def test_poses_are_corrected():
    images, _ = sphere_views(48)  # many right ones hold the field
    rng = np.random.default_rng(0)
    wrong = images.camera_to_world.copy()
    wrong[1:8, :3, 3] += rng.normal(0, 0.15, (7, 3))
    moved = replace(images, camera_to_world=wrong)
    settings = options(steps=400, poses=True, camera_rate=0.1)
    result = fit_ngp(moved, *BOX, TINY_NGP, settings, None, step_m=0.05, cone=0.0)
    fitted = [i for i in range(48) if i % 8]
    true = images.camera_to_world[fitted]

    def off_axis(poses: np.ndarray) -> float:
        """How far the optical axes miss the sphere's centre, on average."""
        eye, axis = poses[:, :3, 3], poses[:, :3, 2]
        return float(np.linalg.norm(np.cross(-eye, axis), axis=1)[:7].mean())

    assert off_axis(true) < 1e-6
    assert off_axis(result.poses) < 0.25 * off_axis(wrong[fitted])
