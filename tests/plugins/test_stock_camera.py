"""The sensor `opencv_camera` against the stock `perspective`, in every variant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.camera_scenes import (
    CROP,
    HEIGHT,
    INTEGRATORS,
    PINHOLE,
    STOCK,
    WIDTH,
    grid_of_pixels,
    load,
    rays,
    sensor,
    world,
)
from helpers.variants import RGB, SPECTRAL

from mi_nerfattack.fields import save_field

IN_COLOUR = pytest.mark.parametrize("each_variant", [*RGB, *SPECTRAL], indirect=True)


@IN_COLOUR
@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("path", {"rfilter": {"type": "box"}}),
        ("aov", {"rfilter": {"type": "gaussian"}, "sample_border": True, **CROP}),
        ("prb", {"rfilter": {"type": "lanczos"}}),
    ],
    ids=["path", "gaussian crop", "lanczos"],
)
def test_image_of_the_stock_sensor(each_variant: str, kind: str, more: Any) -> None:
    images = [
        np.array(mi.render(world(sensor(d, **more), INTEGRATORS[kind]), spp=4, seed=3))
        for d in (PINHOLE, STOCK)
    ]
    assert np.nanmax(images[1]) > 0.5
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-4)


@IN_COLOUR
@pytest.mark.parametrize("more", [{}, CROP], ids=["full", "crop"])
def test_rays_of_the_stock_sensor(each_variant: str, more: Any) -> None:
    ours, theirs = (load(sensor(d, **more)) for d in (PINHOLE, STOCK))
    (a, weight_a), (b, weight_b) = (rays(s, grid_of_pixels()) for s in (ours, theirs))
    for name in ("o", "d", "maxt", "d_x", "d_y", "o_x", "wavelengths"):
        x, y = (np.array(getattr(ray, name)) for ray in (a, b))
        np.testing.assert_allclose(x, y, rtol=2e-6, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(np.array(weight_a), np.array(weight_b), rtol=1e-6)


@IN_COLOUR
@pytest.mark.parametrize("more", [{}, CROP], ids=["full", "crop"])
def test_directions_of_the_stock_sensor(each_variant: str, more: Any) -> None:
    # Centred: the stock sensor leaves out a strip where the principal point is not.
    centred = {"cx": 0.5 * WIDTH, "cy": 0.5 * HEIGHT}
    shifted = ("principal_point_offset_x", "principal_point_offset_y")
    stock = {key: value for key, value in STOCK.items() if key not in shifted}
    ours = load(sensor({**PINHOLE, **centred}, **more))
    theirs = load(sensor(stock, **more))
    spread = np.random.default_rng(0).normal(size=(3, 500)) * 1.5
    it = dr.zeros(mi.Interaction3f, 500)
    it.p = mi.Point3f(spread.astype(np.float32))
    (a, a_weight), (b, b_weight) = (
        s.sample_direction(it, mi.Point2f(0)) for s in (ours, theirs)
    )
    seen = np.array(b.pdf) > 0
    np.testing.assert_array_equal(np.array(a.pdf) > 0, seen)
    assert 0.05 < seen.mean() < 0.95
    for name in ("uv", "d", "dist"):
        x, y = (np.array(getattr(ds, name))[..., seen] for ds in (a, b))
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5, err_msg=name)
    x, y = (np.array(mi.Spectrum(w)[0])[seen] for w in (a_weight, b_weight))
    np.testing.assert_allclose(x, y, rtol=1e-5)


def test_gradients_of_the_stock_sensor(variant: str, tmp_path: Path) -> None:
    path = tmp_path / "blob.safetensors"
    save_field(path, small.blob(np.random.default_rng(0)))
    volume = {"type": "grid_field", "filename": str(path)}
    integrators = {
        "ball.bsdf.reflectance.color0.value": INTEGRATORS["prb"],
        "integrator.box.colour": {"type": "field_integrator", "box": volume},
    }
    for key, integrator in integrators.items():
        gradients = []
        for description in (PINHOLE, STOCK):
            camera = sensor(description, rfilter={"type": "gaussian"}, **CROP)
            scene = world(camera, integrator)
            if "box" in key:
                scene = mi.load_dict(
                    {"type": "scene", "integrator": integrator, "eye": camera},
                    parallel=False,
                )
            params = mi.traverse(scene)
            dr.enable_grad(params[key])
            params.update()
            image = mi.render(scene, params, spp=4, seed=1, seed_grad=2)
            dr.backward(dr.mean(dr.square(image[..., :3])))
            gradients.append(np.array(dr.grad(params[key])))
        assert np.abs(gradients[1]).max() > 1e-5
        scale = np.abs(gradients[1]).max()
        np.testing.assert_allclose(gradients[0], gradients[1], atol=1e-4 * scale)
