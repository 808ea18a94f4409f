"""Colour, opacity and depth against closed forms and float64 quadratures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.exact_fields import (
    GaussianField,
    box_interval,
    piecewise,
    quadrature,
    rays_towards,
)

from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, make_mesh
from mi_nerfattack.fields import save_field
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import DepthComposite
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March

pytestmark = pytest.mark.usefixtures("variant")


def compare(seen: March, radiance: Any, opacity: Any, moment: Any) -> None:
    """Assert colour and opacity within 1e-4 relative, depth within 1e-3."""
    np.testing.assert_allclose(seen.opacity.numpy(), opacity, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(seen.radiance.numpy().T, radiance, rtol=1e-4, atol=1e-7)
    hit = opacity > 0
    depth = np.where(hit, moment / np.where(hit, opacity, 1), np.inf)
    np.testing.assert_allclose(seen.depth.numpy(), depth, rtol=1e-3)


# One field


@pytest.mark.parametrize("density", [1e-4, 0.7, 50.0])
def test_homogeneous_slab(density: float) -> None:
    field = small.homogeneous(density)
    # A sample counts for its interval: where that is opaque, depth knows no better.
    field.step_m = min(0.01, 0.05 / density)
    rays, o, d = rays_towards(np.zeros(3), 0.9)
    seen = march(PosedField(field), rays, 0.0)
    colour = np.full(3, small.sigmoid_to_linear(np.array(0.3)))
    near, far = box_interval(o, d, Pose.identity(), 1.0)
    compare(seen, *piecewise([(near, far, density, colour)]))


@pytest.mark.parametrize("peak", [0.01, 3.0, 40.0])
def test_gaussian_blob(peak: float) -> None:
    field = GaussianField(peak, 0.5, 1.2, step_m=min(0.015, 0.06 / peak))
    place = Pose(np.eye(3), np.array([0.3, -0.2, 0.5]))
    rays, o, d = rays_towards(place.translation, 0.5)
    compare(
        march(PosedField(field, place), rays, 0.0),
        *quadrature([(field, place)], o, d),
    )


# Two fields


def two_boxes() -> tuple[list[PosedField], list[tuple[Pose, float, np.ndarray]]]:
    """Make overlapping boxes; the second is turned, moved and scaled."""
    turned = Pose.upright((0.7, 0.3, 0.1), 0.6, 0.8)
    posed, parts = [], []
    for pose, density, raw in ((Pose.identity(), 0.9, 1.0), (turned, 1.7, -1.5)):
        field = small.homogeneous(density, raw)
        posed.append(PosedField(field, pose))
        colour = np.full(3, small.sigmoid_to_linear(np.array(raw)))
        parts.append((pose, density / pose.scale, colour))
    return posed, parts


def layers_of(parts: Any, o: np.ndarray, d: np.ndarray) -> list[Any]:
    return [
        (*box_interval(o, d, pose, 1.0), density, colour)
        for pose, density, colour in parts
    ]


def test_overlapping_boxes_interleaved() -> None:
    posed, parts = two_boxes()
    rays, o, d = rays_towards(np.array([0.4, 0.1, 0.0]), 0.9, 256)
    seen = InterleavedComposite().render(posed, rays, 0.0)
    layers = layers_of(parts, o, d)
    both = np.minimum(layers[0][1], layers[1][1]) > np.maximum(
        layers[0][0], layers[1][0]
    )
    assert 0.3 < both.mean() < 1
    compare(seen.total, *piecewise(layers))
    # Each share is the medium with the other's colour black.
    black = np.zeros(3)
    for k in range(2):
        dark = [
            (*layer[:3], layer[3] if i == k else black)
            for i, layer in enumerate(layers)
        ]
        share = seen.layers[k].radiance.numpy().T
        np.testing.assert_allclose(share, piecewise(dark)[0], rtol=1e-4, atol=1e-7)


def test_overlapping_blobs_interleaved() -> None:
    shifted = Pose(np.eye(3), np.array([0.5, 0.2, 0.1]))
    blobs = [
        (GaussianField(3.0, 0.5, 0.8, 0.01), Pose.identity()),
        (GaussianField(2.0, 0.4, 0.7, 0.013), shifted),
    ]
    rays, o, d = rays_towards(np.array([0.2, 0.1, 0.0]), 0.3)
    posed = [PosedField(*blob) for blob in blobs]
    seen = InterleavedComposite().render(posed, rays, 0.0).total
    compare(seen, *quadrature(blobs, o, d))


def test_overlapping_boxes_by_depth_are_a4_to_a6() -> None:
    posed, parts = two_boxes()
    rays, o, d = rays_towards(np.array([0.4, 0.1, 0.0]), 0.9, 256)
    alone = [piecewise([layer]) for layer in layers_of(parts, o, d)]
    depth = [m / np.where(a > 0, a, 1) + np.where(a > 0, 0, 1e9) for _, a, m in alone]
    first = depth[0] <= depth[1]

    def fold(k: int) -> np.ndarray:
        p, q = alone[0][k], alone[1][k]
        front, back = np.where(first, p.T, q.T).T, np.where(first, q.T, p.T).T
        a = np.where(first, alone[0][1], alone[1][1])
        return front + ((1 - a) * back.T).T

    seen = DepthComposite().render(posed, rays, 0.0).total
    compare(seen, fold(0), fold(1), fold(2))
    # Opacity is the same product in any order; colour is not the exact one.
    exact = piecewise(layers_of(parts, o, d))
    np.testing.assert_allclose(fold(1), exact[1], rtol=1e-9)
    assert np.abs(fold(0) - exact[0]).max() > 0.02


# Through Mitsuba


def sensor(fov: float) -> dict[str, Any]:
    """Describe a camera at x = 3 that looks at the origin."""
    eye = mi.ScalarTransform4f().look_at([3.0, 0.4, 0.3], [0, 0, 0], [0, 0, 1])
    film = {
        "type": "hdrfilm",
        "width": 40,
        "height": 30,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return {"type": "perspective", "fov": fov, "to_world": eye, "film": film}


def window(path: Path, x: float) -> None:
    """Write a wall in the plane of one x that faces +x, with a rectangular hole."""
    outer = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)]
    inner = [(-0.6, -0.4), (0.5, -0.4), (0.5, 0.45), (-0.6, 0.45)]
    corners = np.array([(x, y, z) for y, z in outer + inner], np.float32)
    faces = []
    for i in range(4):
        j = (i + 1) % 4
        faces += [(i, j, 4 + j), (i, 4 + j, 4 + i)]
    make_mesh("wall", MeshArrays(corners, np.array(faces))).write_ply(str(path))


@pytest.mark.parametrize("x", [1.5, 0.2, -1.5], ids=["before", "within", "behind"])
def test_field_and_window_of_mesh(tmp_path: Path, x: float) -> None:
    density, wall, sky = 0.7, 2.0, 0.25
    save_field(tmp_path / "box.safetensors", small.homogeneous(density))
    window(tmp_path / "wall.ply", x)
    volume = {"type": "grid_field", "filename": str(tmp_path / "box.safetensors")}
    light = {"type": "area", "radiance": {"type": "rgb", "value": wall}}
    dark = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    path = str(tmp_path / "wall.ply")
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "field_integrator",
                "stop": 0.0,
                "aovs": True,
                "box": volume,
                "behind": {"type": "path", "max_depth": 2},
            },
            "sensor": sensor(60.0),
            "wall": {"type": "ply", "filename": path, "light": light, "bsdf": dark},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": sky}},
        },
        parallel=False,
    )
    image = np.array(mi.render(scene, spp=1, seed=0)).reshape(-1, 10)
    ray = small.first_rays(scene)
    o, d = ray.o.numpy().T.astype(float), ray.d.numpy().T.astype(float)
    t_wall = (x - o[:, 0]) / d[:, 0]
    y, z = (o + t_wall[:, None] * d)[:, 1:].T
    hole = (y > -0.6) & (y < 0.5) & (z > -0.4) & (z < 0.45)
    assert 0.03 < hole.mean() < 0.6

    near, far = box_interval(o, d, Pose.identity(), 1.0, np.where(hole, 1e9, t_wall))
    colour = np.full(3, small.sigmoid_to_linear(np.array(0.3)))
    radiance, opacity, moment = piecewise([(near, far, density, colour)])
    behind = np.where(hole, sky, wall)
    expected = radiance + ((1 - opacity) * behind)[:, None]
    np.testing.assert_allclose(image[:, :3], expected, rtol=1e-4)
    np.testing.assert_allclose(image[:, 3], opacity, rtol=1e-4, atol=1e-6)
    hit = opacity > 0
    assert hit.any() and not hit.all()
    assert np.all(image[~hit, 4] == np.inf)
    np.testing.assert_allclose(image[hit, 4], moment[hit] / opacity[hit], rtol=1e-3)


# What lies beyond the box


def sky_colour(raw: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Interpolate a latitude-longitude image (h, w, 3) of raw colours at (n, 3).

    Columns start at +x and turn towards +y, with the first texel's border there; rows
    run from +z to -z with texels at their middles.
    """
    height, width, _ = raw.shape
    u = np.arctan2(d[:, 1], d[:, 0]) / (2 * np.pi) * width
    v = np.arccos(d[:, 2]) / np.pi * height - 0.5
    u0, v0 = np.floor(u).astype(int), np.floor(v).astype(int)
    result = np.zeros((len(d), 3))
    for i in (0, 1):
        for j in (0, 1):
            weight = abs(1 - i - (u - u0)) * abs(1 - j - (v - v0))
            row = np.clip(v0 + j, 0, height - 1)
            result += weight[:, None] * raw[row, (u0 + i) % width]
    return small.sigmoid_to_linear(result)


@pytest.mark.parametrize("angle", [0.0, 70.0], ids=["upright", "turned"])
def test_rays_that_leave_the_box_see_the_sky(tmp_path: Path, angle: float) -> None:
    field = small.small_ngp()
    save_field(tmp_path / "ngp.safetensors", field)
    raw = field.sky.numpy().astype(np.float64).reshape(4, 8, 3)
    turn = mi.ScalarTransform4f().rotate([0.6, 0, 0.8], angle)
    volume = {
        "type": "ngp_field",
        "filename": str(tmp_path / "ngp.safetensors"),
        "to_world": turn,
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "field_integrator",
                "stop": 0.0,
                "aovs": True,
                "ngp": volume,
            },
            "sensor": sensor(100.0),
        },
        parallel=False,
    )
    image = np.array(mi.render(scene, spp=1, seed=0)).reshape(-1, 10)
    d = small.first_rays(scene).d.numpy().T.astype(float)
    local = d @ np.array(turn.matrix)[:3, :3]  # the transpose: into the field's frame
    sky = sky_colour(raw, local)
    # Channels 5 to 7 are the field alone, premultiplied.
    expected = image[:, 5:8] + (1 - image[:, 3:4]) * sky
    np.testing.assert_allclose(image[:, :3], expected, rtol=1e-4, atol=1e-5)
    missed = image[:, 3] == 0
    assert 0.3 < missed.mean() < 0.95
    np.testing.assert_allclose(image[missed, :3], sky[missed], rtol=1e-4, atol=1e-5)
    assert image[~missed, 3].max() < 1  # the sky shows through the field too
