"""The sensor `opencv_camera` against float64 references and the stock `perspective`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import RGB, SPECTRAL
from support.worlds import cameras as cams

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.conventions import from_mitsuba, mitsuba_sensor_dict
from mi_nerfattack.render.camera.intrinsics import Camera, look_at

pytestmark = pytest.mark.usefixtures("variant")

LENSES = pytest.mark.parametrize(
    "camera", [cams.RADIAL, cams.WIDE], ids=["radial", "fisheye"]
)
POSE = look_at([1.0, 2, 3], [0, 0, 0])


def made(camera: Camera, **crop: Any) -> mi.Sensor:
    return cams.load(mitsuba_sensor_dict(camera, POSE, 1, crop))


def local(direction: Any) -> np.ndarray:
    """Turn directions of the world into right, down, forward of the camera, (n, 3)."""
    return direction.numpy().T.astype(np.float64) @ POSE[:3, :3]


@LENSES
@pytest.mark.parametrize("crop", [{}, cams.CROP], ids=["full", "crop"])
def test_rays_and_differentials_look_where_the_lens_says(camera, crop) -> None:
    loaded = made(camera, **crop)
    back, pose = from_mitsuba(loaded)
    np.testing.assert_allclose(back.distortion, camera.distortion, rtol=1e-6)
    np.testing.assert_allclose(pose, POSE, atol=1e-6)
    u, v = cams.pixels(camera)
    ray, _ = cams.rays(loaded, np.stack([u, v], 1))
    expected = cams.directions(camera, u, v)
    np.testing.assert_allclose(local(ray.d), expected, atol=3e-6)
    # Rays start at the near plane, of a fisheye on a sphere.
    offset = local(ray.o - loaded.world_transform().translation())
    reach = np.linalg.norm(offset, axis=1) if camera.is_fisheye else offset[:, 2]
    np.testing.assert_allclose(reach, 1e-2, rtol=1e-4)
    for there, (a, b) in ((ray.d_x, (1, 0)), (ray.d_y, (0, 1))):
        if camera.is_fisheye:
            next_pixel = cams.directions(camera, u + a, v + b)
            np.testing.assert_allclose(local(there), next_pixel, atol=3e-6)
            continue
        ahead, behind = (
            cams.directions(camera, u + s * a, v + s * b) for s in (0.25, -0.25)
        )
        tangent = (ahead - behind) / 0.5
        # A unit vector of the next pixel differs by the curvature of the sphere.
        error = np.abs(local(there) - expected - tangent)
        assert np.all(error < 0.04 * np.linalg.norm(tangent, axis=1)[:, None])


@LENSES
def test_points_are_connected_to_the_pixels_that_show_them(camera) -> None:
    corner, size = np.array([15.0, 7.0]), np.array([20, 16])
    loaded = made(camera, **cams.CROP)
    place = corner + np.random.default_rng(1).uniform(0.02, 0.98, (200, 2)) * size
    ray, _ = cams.rays(loaded, place)
    it = dr.zeros(mi.Interaction3f, 200)
    it.p = ray(mi.Float(2.5))
    ds, weight = loaded.sample_direction(it, mi.Point2f(0))
    assert np.all(np.array(ds.pdf) == 1)
    np.testing.assert_allclose(ds.uv.numpy().T, place - corner, atol=2e-3)
    np.testing.assert_allclose(ds.d.numpy(), -ray.d.numpy(), atol=1e-5)
    # Importance: samples of the window per solid angle, over squared distance.
    u, v = place.T
    by = [
        (cams.directions(camera, u + a, v + b) - cams.directions(camera, u - a, v - b))
        / 2e-3
        for a, b in ((1e-3, 0), (0, 1e-3))
    ]
    solid_angle = np.linalg.norm(np.cross(*by), axis=1)
    expected = 1 / (solid_angle * size.prod() * ds.dist.numpy() ** 2)
    np.testing.assert_allclose(weight.x.numpy(), expected, rtol=2e-3)


def test_points_that_fold_into_the_image_are_not_seen() -> None:
    # With k1 < 0 the lens maps far directions back into the image: at x = 3,
    # x (1 + k1 x^2) = 0.3. OpenCV projects them there, but no ray goes that way.
    folding = {"type": "opencv_camera", "fx": 60.0, "k1": -0.1}
    it = dr.zeros(mi.Interaction3f, 1)
    camera = cams.load({**folding, "film": cams.film()})
    for x, is_visible in ((0.29, True), (3.0, False)):
        it.p = mi.Point3f(x, 0, 1)
        ds, weight = camera.sample_direction(it, mi.Point2f(0))
        assert abs(ds.uv.x[0] - cams.WIDTH / 2) < cams.WIDTH / 2
        assert (ds.pdf[0] > 0, weight.x[0] > 0) == (is_visible, is_visible)


# Derivatives and kernels


@pytest.mark.parametrize(
    ("camera", "name"),
    [(cams.RADIAL, name) for name in (*cams.LENS, "to_world")]
    + [(cams.WIDE, name) for name in ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_rays_derivative(camera: Camera, name: str) -> None:
    u, v = cams.pixels(camera)
    towards = np.random.default_rng(0).normal(size=(len(u), 3))
    loaded = made(camera)
    params = mi.traverse(loaded)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    if name == "to_world":
        params[name] = mi.AffineTransform4f().rotate([0, 1, 0], shift) @ params[name]
    else:
        params[name] = params[name] + shift
    params.update()
    direction = cams.rays(loaded, np.stack([u, v], 1))[0].d
    dr.forward(shift, dr.ADFlag.ClearEdges)
    derivative = (dr.grad(direction).numpy().T * towards).sum()

    def projected(step: float) -> float:
        lens, c, s = camera, np.cos(np.radians(step)), np.sin(np.radians(step))
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        if name != "to_world":
            lens, turn = (
                replace(camera, **{name: getattr(camera, name) + step}),
                np.eye(3),
            )
        shown = cams.directions(lens, u, v) @ (turn @ POSE[:3, :3]).T
        return (shown * towards).sum()

    step = 1e-5
    expected = (projected(step) - projected(-step)) / (2 * step)
    assert derivative == pytest.approx(expected, rel=1e-3)


def test_nothing_is_compiled_for_another_pose_or_lens() -> None:
    camera = cams.sensor({"type": "opencv_camera", **cams.LENS}, width=31, height=17)
    scene = cams.world(camera, cams.INTEGRATORS["prb"])
    params = mi.traverse(scene)

    def frame(index: int) -> np.ndarray:
        eye = [1.0, index, -4.0]
        params["eye.to_world"] = mi.Transform4f().look_at(eye, [0, 0, 0], [0, 1, 0])
        for name, step in (("fx", 1.0), ("k1", 1e-3), ("p2", 1e-3)):
            params[f"eye.{name}"] = cams.LENS[name] + step * index
        params.update()
        return np.array(mi.render(scene, spp=2, seed=1))

    # The second frame of a scene differs from the first with the stock sensor too.
    frame(1)
    image = frame(2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        assert abs(frame(3) - image).max() > 0.1
        history = dr.kernel_history((dr.KernelType.JIT,))
    # What another process compiled comes from a cache on disk.
    assert history and all(k["cache_hit"] and not k["cache_disk"] for k in history)


# Properties


# At fx 30, k1 -0.155 holds an image of 48 x 32 pixels, but not its filter's border.
BORDER = {"type": "hdrfilm", "width": 48, "height": 32, "sample_border": True}


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"fx": -3.0}, "camera.fx: -3.0; must be positive"),
        ({"cx": float("nan")}, "camera.cx: nan; must be finite"),
        ({"k1": -5.0}, "folds the image over itself"),
        ({"k1": -0.155, "film": BORDER}, "folds the image over itself"),
        ({"near_clip": 0.0}, "near_clip, far_clip: 0, .*expected 0 < near < far"),
        ({"near_clip": 2.0, "far_clip": 1.0}, "near_clip, far_clip: 2, 1"),
        ({"k3": 0.1}, "k3: not of this lens"),
        ({"fisheye": True, "p1": 0.1}, "p1: not of this lens"),
        ({"fov": 40.0}, 'unreferenced property.*\n.*"fov"'),
        ({"to_world": 2}, "takes rotation and translation"),
        ({"fx": None}, 'property named "fx"'),
    ],
)
def test_wrong_properties(properties: dict[str, Any], message: str) -> None:
    wrong = {"type": "opencv_camera", "fx": 30.0, "film": cams.film(), **properties}
    if wrong["fx"] is None:
        del wrong["fx"]
    if "to_world" in wrong:
        wrong["to_world"] = mi.ScalarTransform4f().scale(wrong["to_world"])
    with pytest.raises(RuntimeError, match=message):
        cams.load(wrong)


def test_impossible_changes_are_refused() -> None:
    # the border counts only where it is sampled
    camera = {"type": "opencv_camera", "fx": 30.0, "k1": -0.155, "film": cams.film()}
    params = mi.traverse(cams.load(camera))
    for name, value, where in (
        ("k1", -5.0, "camera.k1, k2, p1, p2"),
        ("fx", -1.0, "camera.fx"),
        ("to_world", mi.Transform4f().scale(2), "to_world"),
    ):
        before = type(params[name])(params[name])
        params[name] = value
        with pytest.raises(InputError) as caught:
            params.update()
        assert caught.value.where == where
        params[name] = before
        params.update()


def test_lens_is_in_the_middle_and_square_by_default() -> None:
    text = str(mi.load_dict({"type": "opencv_camera", "fx": 600.0, "k1": -0.1}))
    assert "fx=600, fy=600, cx=384, cy=288, k1=-0.1" in text


# Against the stock `perspective`

IN_COLOUR = pytest.mark.parametrize("each_variant", [*RGB, *SPECTRAL], indirect=True)


@IN_COLOUR
@pytest.mark.parametrize("crop", [{}, cams.CROP], ids=["full", "crop"])
def test_rays_of_the_stock_sensor(each_variant: str, crop: Any) -> None:
    ours, theirs = (
        cams.load(cams.sensor(d, **crop)) for d in (cams.PINHOLE, cams.STOCK)
    )
    (a, weight_a), (b, weight_b) = (
        cams.rays(s, cams.grid_of_pixels()) for s in (ours, theirs)
    )
    for name in ("o", "d", "maxt", "d_x", "d_y", "o_x", "wavelengths"):
        x, y = (np.array(getattr(ray, name)) for ray in (a, b))
        np.testing.assert_allclose(x, y, rtol=2e-6, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(np.array(weight_a), np.array(weight_b), rtol=1e-6)


@IN_COLOUR
@pytest.mark.parametrize("crop", [{}, cams.CROP], ids=["full", "crop"])
def test_directions_of_the_stock_sensor(each_variant: str, crop: Any) -> None:
    # Centred: the stock sensor leaves out a strip where the principal point is not.
    centred = {"cx": 0.5 * cams.WIDTH, "cy": 0.5 * cams.HEIGHT}
    shifted = ("principal_point_offset_x", "principal_point_offset_y")
    stock = {key: value for key, value in cams.STOCK.items() if key not in shifted}
    ours = cams.load(cams.sensor({**cams.PINHOLE, **centred}, **crop))
    theirs = cams.load(cams.sensor(stock, **crop))
    spread = np.random.default_rng(0).normal(size=(3, 500)) * 1.5
    it = dr.zeros(mi.Interaction3f, 500)
    it.p = mi.Point3f(spread.astype(np.float32))
    (a, a_weight), (b, b_weight) = (
        s.sample_direction(it, mi.Point2f(0)) for s in (ours, theirs)
    )
    visible = np.array(b.pdf) > 0
    np.testing.assert_array_equal(np.array(a.pdf) > 0, visible)
    assert 0.05 < visible.mean() < 0.95
    for name in ("uv", "d", "dist"):
        x, y = (np.array(getattr(ds, name))[..., visible] for ds in (a, b))
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5, err_msg=name)
    x, y = (np.array(mi.Spectrum(w)[0])[visible] for w in (a_weight, b_weight))
    np.testing.assert_allclose(x, y, rtol=1e-5)


@IN_COLOUR
@pytest.mark.parametrize("kind", ["aov", "prb"])
def test_image_of_the_stock_sensor(each_variant: str, kind: str) -> None:
    film = {"rfilter": {"type": "gaussian"}, "sample_border": True, **cams.CROP}
    scenes = (
        cams.world(cams.sensor(d, **film), cams.INTEGRATORS[kind])
        for d in (cams.PINHOLE, cams.STOCK)
    )
    ours, theirs = (np.array(mi.render(scene, spp=4, seed=3)) for scene in scenes)
    assert np.nanmax(theirs) > 0.5
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)
