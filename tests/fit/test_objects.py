"""Whole ways of objects: a real mesh, and pictures that go in and come out again."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.mesh_samples import four_colours
from PIL import Image

from mi_nerfattack.capture.mesh.cube_faces import render_faces
from mi_nerfattack.capture.mesh.mesh import CUBE_FACES
from mi_nerfattack.commands.asset import Asset
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.fit.scores import FieldRenderer
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.slow]


def test_duck_is_upright_metric_and_yellow(data_folder, tmp_path):
    """Its bill points to +x; 0.3 m high, 0.322 m long, 0.224 m wide, as its file."""
    duck, out = data_folder / "assets" / "Duck.glb", tmp_path / "duck.safetensors"
    Asset(str(duck), out, height_m=0.3, views=16, size=96, steps=100).run()
    field = load_grid(out)
    renderer, camera = FieldRenderer(field, over_white=True), from_fov(96, 96, 40.0)
    middle = np.array([0, 0, 0.15])
    side = renderer.render(camera, look_at(middle - [0, 0.6, 0], middle))
    # at the middle of the duck a pixel is 0.6 m / fx wide
    rows, columns = np.nonzero(side.opacity > 0.5)
    pixel = 0.6 / camera.fx
    x, z = (columns - 47.5) * pixel, 0.15 + (47.5 - rows) * pixel
    near = {"abs": 0.025}
    assert x.min() == pytest.approx(-0.161, **near)
    assert x.max() == pytest.approx(0.161, **near)
    assert z.min() == pytest.approx(0.0, **near)
    assert z.max() == pytest.approx(0.3, **near)
    front = renderer.render(camera, look_at(middle + [0.6, 0, 0], middle))
    across = np.nonzero((front.opacity > 0.5).any(0))[0]
    assert (across[-1] - across[0]) * pixel == pytest.approx(0.224, abs=0.04)
    # head up: the upper third is narrower than the lower
    widths = (side.opacity > 0.5).sum(1)[rows.min() : rows.max() + 1]
    third = len(widths) // 3
    assert widths[:third].max() < 0.7 * widths[-third:].max()
    red, green, blue = body = side.image[70, 48]
    assert red > 0.7 and 0.5 < green < red and blue < 0.3
    # what reaches furthest to +x above the body is the bill: less green, orange
    solid = side.opacity[rows, columns] > 0.95
    tip = solid & (z > 0.15) & (x > 0.12)
    assert tip.sum() > 20
    bill = side.image[rows[tip], columns[tip]].mean(0)
    assert bill[0] > 0.7 and bill[2] < 0.4
    assert bill[1] / bill[0] < 0.85 * body[1] / body[0]


def test_pictures_of_a_cube_come_out_again(tmp_path):
    """In light from everywhere a convex object's radiance is its reflectance."""
    for i, name in enumerate(CUBE_FACES):
        picture = np.rot90(np.array(four_colours(64)), i % 4)
        Image.fromarray(np.ascontiguousarray(picture)).save(tmp_path / f"{name}.png")
    out = tmp_path / "cube.safetensors"
    Asset(
        "cube",
        out,
        edge_m=0.5,
        faces=tmp_path,
        ambient=1.0,
        views=32,
        size=96,
        steps=120,
    ).run()
    faces = render_faces(load_grid(out), 128.0)
    np.testing.assert_allclose(faces.upper - faces.lower, 0.5)
    for i, name in enumerate(CUBE_FACES):
        if name == "nz":  # few views look at it from below
            continue
        expected = np.rot90(np.array(four_colours(64)), i % 4).astype(float)
        found = faces.images[name].astype(float)
        assert found.shape == (64, 64, 4)
        inner = np.r_[6:26, 38:58]
        difference = np.abs(found[..., :3] - expected)[np.ix_(inner, inner)]
        assert difference.mean() < 20, name
        assert found[np.ix_(inner, inner)][..., 3].mean() > 250
