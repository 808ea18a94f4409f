"""The sensor `opencv_camera` against OpenCV's projection, and as a scene's sensor."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.camera_scenes import (
    CROP,
    EYE,
    INTEGRATORS,
    LENS,
    WIDTH,
    film,
    grid_of_pixels,
    load,
    rays,
    sensor,
    world,
)


def opencv_pixels(points: np.ndarray) -> np.ndarray:
    """Project points (n, 3) of Mitsuba's camera frame with OpenCV, (n, 2)."""
    import cv2

    # OpenCV counts from the centre of the first pixel.
    matrix = np.array(
        [
            [LENS["fx"], 0, LENS["cx"] - 0.5],
            [0, LENS["fy"], LENS["cy"] - 0.5],
            [0, 0, 1],
        ]
    )
    lens = np.array([LENS[name] for name in ("k1", "k2", "p1", "p2")])
    axes = points * [-1.0, -1.0, 1.0]
    projected = cv2.projectPoints(axes, np.zeros(3), np.zeros(3), matrix, lens)[0]
    return projected[:, 0] + 0.5


# Against OpenCV


@pytest.mark.parametrize("more", [{}, CROP], ids=["full", "crop"])
def test_rays_project_back_with_opencv(variant: str, more: Any) -> None:
    camera = load(sensor({"type": "opencv_camera", **LENS}, **more))
    pixel = grid_of_pixels()
    ray, _ = rays(camera, pixel)
    to_local = np.linalg.inv(np.array(camera.world_transform().matrix).reshape(4, 4))
    local = ray.d.numpy().T.astype(np.float64) @ to_local[:3, :3].T
    np.testing.assert_allclose(opencv_pixels(local), pixel, atol=1e-4)


def test_ray_differentials_are_the_next_pixels(variant: str) -> None:
    camera = load(sensor({"type": "opencv_camera", **LENS}))
    pixel = grid_of_pixels() * 0.9
    ray, _ = rays(camera, pixel)
    for name, step in (("d_x", [0.25, 0]), ("d_y", [0, 0.25])):
        # The differential is the tangent: central differences within a pixel.
        ahead, back = (rays(camera, pixel + sign * np.array(step)) for sign in (1, -1))
        expected = (ahead[0].d - back[0].d).numpy() / 0.5
        tangent = (getattr(ray, name) - ray.d).numpy()
        size = np.linalg.norm(expected, axis=0)
        # A unit vector of the next pixel differs by the curvature of the sphere.
        assert np.all(np.abs(tangent - expected) < 0.04 * size)


def test_directions_are_rays_reversed(variant: str) -> None:
    camera = load(sensor({"type": "opencv_camera", **LENS}, **CROP))
    offset, size = np.array([15.0, 7.0]), np.array([20, 16])
    pixel = offset + np.random.default_rng(1).uniform(0.02, 0.98, (200, 2)) * size
    ray, _ = rays(camera, pixel)
    it = dr.zeros(mi.Interaction3f, 200)
    it.p = ray(mi.Float(2.5))
    ds, weight = camera.sample_direction(it, mi.Point2f(0))
    assert np.all(np.array(ds.pdf) == 1)
    np.testing.assert_allclose(ds.uv.numpy().T, pixel - offset, atol=2e-3)
    np.testing.assert_allclose(ds.d.numpy(), -ray.d.numpy(), atol=1e-5)
    # Importance: samples of the window per solid angle, over squared distance.
    steps = 0.25 * np.eye(2)
    by = [
        (rays(camera, pixel + s)[0].d - rays(camera, pixel - s)[0].d).numpy() / 0.5
        for s in steps
    ]
    solid_angle = np.linalg.norm(np.cross(by[0].T, by[1].T), axis=1)
    expected = 1 / (solid_angle * size.prod() * ds.dist.numpy() ** 2)
    np.testing.assert_allclose(weight.x.numpy(), expected, rtol=2e-3)


def test_points_that_fold_into_the_image_are_not_seen(variant: str) -> None:
    # With k1 < 0 the lens maps far directions back into the image: at x = 3,
    # x (1 + k1 x^2) = 0.3. OpenCV projects them there, but no ray goes that way.
    folding = {"type": "opencv_camera", "fx": 60.0, "k1": -0.1}
    it = dr.zeros(mi.Interaction3f, 1)
    camera = load({**folding, "film": film()})
    for x, seen in ((0.29, True), (3.0, False)):
        it.p = mi.Point3f(x, 0, 1)
        ds, weight = camera.sample_direction(it, mi.Point2f(0))
        assert abs(ds.uv.x[0] - WIDTH / 2) < WIDTH / 2
        assert (ds.pdf[0] > 0, weight.x[0] > 0) == (seen, seen)


# Derivatives and kernels


@pytest.mark.parametrize("name", [*LENS, "to_world"])
def test_rays_derivative(variant: str, name: str) -> None:
    pixel = grid_of_pixels(8.0) * 0.95
    towards = np.random.default_rng(0).normal(size=(3, len(pixel)))

    def along(shift: Any) -> Any:
        camera = load(sensor({"type": "opencv_camera", **LENS}))
        params = mi.traverse(camera)
        if name == "to_world":
            moved = mi.Transform4f().rotate([0, 1, 0], shift)
            params[name] = moved @ mi.Transform4f().look_at(EYE, [0, 0, 0], [0, 1, 0])
        else:
            params[name] = mi.Float(LENS[name]) + shift
        params.update()
        return rays(camera, pixel)[0].d

    shift = mi.Float(0)
    dr.enable_grad(shift)
    direction = along(shift)
    dr.forward(shift, dr.ADFlag.ClearEdges)
    found = (dr.grad(direction).numpy() * towards).sum()
    step = 0.05 if name[0] in "fct" else 5e-3
    ahead, back = (along(mi.Float(s)).numpy().astype(float) for s in (step, -step))
    expected = ((ahead - back) * towards).sum() / (2 * step)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("lens", [{"fx": 30.0}, LENS], ids=["pinhole", "lens"])
def test_nothing_is_compiled_for_another_pose_or_lens(variant: str, lens: Any) -> None:
    camera = sensor({"type": "opencv_camera", **lens}, width=31, height=17)
    scene = world(camera, INTEGRATORS["prb"])
    params = mi.traverse(scene)

    def frame(index: int) -> np.ndarray:
        eye = [1.0, index, -4.0]
        params["eye.to_world"] = mi.Transform4f().look_at(eye, [0, 0, 0], [0, 1, 0])
        params["eye.fx"] = 31.0 + index
        for name in ("k1", "p2"):
            if name in lens:
                params[f"eye.{name}"] = lens[name] + 1e-3 * index
        params.update()
        return np.array(mi.render(scene, spp=2, seed=1))

    def kernels(index: int) -> tuple[set[str], np.ndarray]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            image = frame(index)
            history = dr.kernel_history()
        return {k["hash"] for k in history if k["type"] == dr.KernelType.JIT}, image

    # By their hash: what another process compiled comes from a cache on disk. The
    # second frame of a scene differs from the first with the stock sensor too.
    kernels(1)
    known, image = kernels(2)
    for index in (3, 4):
        later, other = kernels(index)
        assert later and later <= known
        assert abs(other - image).max() > 0.1


# Properties


# At fx 30, k1 -0.155 holds an image of 48 x 32 pixels, but not its filter's border.
BORDER = {"type": "hdrfilm", "width": 48, "height": 32, "sample_border": True}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"fx": -3.0}, "camera.fx: -3.0; must be positive"),
        ({"fy": 0.0}, "camera.fy: 0.0; must be positive"),
        ({"cx": float("nan")}, "camera.cx: nan; must be finite"),
        ({"k1": -5.0}, "folds the image over itself"),
        ({"k1": -0.155, "film": BORDER}, "folds the image over itself"),
        ({"near_clip": 0.0}, "near_clip, far_clip: 0, .*expected 0 < near < far"),
        ({"near_clip": 2.0, "far_clip": 1.0}, "near_clip, far_clip: 2, 1"),
        ({"k3": 0.1}, 'unreferenced property.*\n.*"k3"'),
        ({"fov": 40.0}, 'unreferenced property.*\n.*"fov"'),
    ],
)
def test_wrong_properties(variant: str, more: Any, message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        load({"type": "opencv_camera", "fx": 30.0, "film": film(), **more})


def test_border_counts_only_where_it_is_sampled(variant: str) -> None:
    load({"type": "opencv_camera", "fx": 30.0, "k1": -0.155, "film": film()})


def test_focal_length_is_required(variant: str) -> None:
    with pytest.raises(RuntimeError, match='property named "fx"'):
        load({"type": "opencv_camera", "film": film()})


def test_scaled_pose_is_refused(variant: str) -> None:
    scaled = mi.ScalarTransform4f().scale(2)
    with pytest.raises(RuntimeError, match="takes rotation and translation"):
        load({"type": "opencv_camera", "fx": 9.0, "to_world": scaled})


def test_impossible_changes_are_refused(variant: str) -> None:
    params = mi.traverse(load({"type": "opencv_camera", "fx": 30.0, "film": film()}))
    for name, value, message in (
        ("k1", -5.0, "folds"),
        ("fx", -1.0, "camera.fx"),
        ("to_world", mi.Transform4f().scale(2), "rotation and translation"),
    ):
        before = type(params[name])(params[name])
        params[name] = value
        with pytest.raises(ValueError, match=message):
            params.update()
        params[name] = before
        params.update()


def test_xml(variant: str) -> None:
    scene = mi.load_string(
        '<scene version="3.0.0"><sensor type="opencv_camera">'
        '<float name="fx" value="250"/><float name="fy" value="252"/>'
        '<float name="k1" value="-0.1"/><transform name="to_world"><lookat '
        'origin="3, 1, 1.5" target="0, 0, 0" up="0, 0, 1"/></transform>'
        '<film type="hdrfilm"><integer name="width" value="320"/>'
        '<integer name="height" value="240"/></film></sensor></scene>',
        parallel=False,
    )
    text = str(scene.sensors()[0])
    assert "fx=250, fy=252, cx=160, cy=120, k1=-0.1" in text
    camera = {"type": "opencv_camera", "fx": 600.0, "fy": 605.0, "k1": -0.1}
    text = str(mi.load_dict(camera))
    assert "fx=600, fy=605, cx=384, cy=288, k1=-0.1" in text
