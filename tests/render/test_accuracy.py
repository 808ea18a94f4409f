"""Colour, opacity and depth against closed forms and float64 quadratures.

Also the order of convergence, and the bounds that `march` documents.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from support.reference.fields import (
    GaussianField,
    box_interval,
    piecewise,
    quadrature,
    rays_towards,
)
from support.worlds import fields as small

from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, make_mesh
from mi_nerfattack.fields import GridField, GridLayout, save_field
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import DepthComposite
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

pytestmark = pytest.mark.usefixtures("variant")


def test_overlapping_boxes_interleaved() -> None:
    """The second box is turned, moved and scaled."""
    turned = Pose.upright((0.7, 0.3, 0.1), 0.6, 0.8)
    rays, o, d = rays_towards(np.array([0.4, 0.1, 0.0]), 0.9, 256)
    posed, layers, black = [], [], []
    for pose, density, raw in ((Pose.identity(), 0.9, 1.0), (turned, 1.7, -1.5)):
        posed.append(PosedField(small.homogeneous(density, raw), pose))
        colour = np.full(3, small.sigmoid_to_linear(np.array(raw)))
        layer = (*box_interval(o, d, pose, 1.0), density / pose.scale)
        layers.append((*layer, colour))
        black.append((*layer, 0 * colour))
    (a, b, *_), (near, far, *_) = layers
    assert 0.3 < (np.minimum(b, far) > np.maximum(a, near)).mean() < 1
    marches = InterleavedComposite().render(posed, rays, 0.0)
    radiance, opacity, moment = piecewise(layers)
    total = marches.total
    np.testing.assert_allclose(total.radiance.numpy().T, radiance, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(total.opacity.numpy(), opacity, rtol=1e-4, atol=1e-7)
    hit = opacity > 0
    depth = np.where(hit, moment / np.where(hit, opacity, 1), np.inf)
    np.testing.assert_allclose(total.depth.numpy(), depth, rtol=1e-3)
    # Each share is the medium with the other's colour black.
    for k, pair in enumerate(([layers[0], black[1]], [black[0], layers[1]])):
        share = marches.layers[k].radiance.numpy().T
        np.testing.assert_allclose(share, piecewise(pair)[0], rtol=1e-4, atol=1e-7)


# Through Mitsuba

EYE, SIZE = (3.0, 0.4, 0.3), {"width": 40, "height": 30}


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
    box = {"type": "grid_field", "filename": str(tmp_path / "box.safetensors")}
    light = {"type": "area", "radiance": {"type": "rgb", "value": wall}}
    dark = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    path = str(tmp_path / "wall.ply")
    world = {
        "wall": {"type": "ply", "filename": path, "light": light, "bsdf": dark},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": sky}},
    }
    seeing = {"aovs": True, "box": box, "behind": {"type": "path", "max_depth": 2}}
    scene = small.load(seeing, world, eye=EYE, fov=60, **SIZE)
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
    path = str(tmp_path / "ngp.safetensors")
    volume = {"type": "ngp_field", "filename": path, "to_world": turn}
    scene = small.load({"aovs": True, "ngp": volume}, eye=EYE, fov=100, **SIZE)
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
    # The sky does not lie behind surfaces.
    wall = small.T().translate([-2, 0, 0]).rotate([0, 1, 0], 90).scale(99)
    surface = {"wall": {"type": "rectangle", "to_world": wall}}
    walled = small.load({"aovs": True, "ngp": volume}, surface, eye=EYE, **SIZE)
    image = np.array(mi.render(walled, spp=1))
    np.testing.assert_allclose(image[..., :3], image[..., 5:8], atol=1e-5)
    assert image[..., 3].max() > 0.1


# Bounds of the error


def numbers(integrals: March) -> list[np.ndarray]:
    arrays = (integrals.radiance, integrals.opacity, integrals.moment)
    return [a.numpy().astype(np.float64).T for a in arrays]


@pytest.mark.parametrize("overlap", [False, True], ids=["march", "interleaved"])
def test_error_falls_by_four_when_the_step_halves(overlap: bool) -> None:
    # Boxes cut the blobs where they are steep, or the error would fall faster.
    blobs = [(GaussianField(3.0, 0.5, 0.6, 1.0), Pose.identity())]
    if overlap:
        shifted = Pose(np.eye(3), np.array([0.5, 0.2, 0.1]))
        blobs.append((GaussianField(2.0, 0.6, 0.7, 1.0), shifted))
    rays, o, d = rays_towards(np.array([0.1, 0.0, 0.0]), 0.3, 256)
    expected = quadrature(blobs, o, d)

    def errors(step: float) -> np.ndarray:
        for field, _ in blobs:
            field.step_m = step
        posed = [PosedField(*blob) for blob in blobs]
        integrals = InterleavedComposite().render(posed, rays, 0.0).total
        if not overlap:
            integrals = march(posed[0], rays, 0.0)
        return np.array(
            [
                np.sqrt(np.mean((a - b) ** 2))
                for a, b in zip(numbers(integrals), expected, strict=True)
            ]
        )

    coarse, middle, fine = errors(0.1), errors(0.05), errors(0.025)
    assert np.all((coarse / middle > 3.4) & (coarse / middle < 4.6)), coarse / middle
    assert np.all((middle / fine > 3.6) & (middle / fine < 4.4)), middle / fine


@pytest.mark.parametrize("step", [0.2, 0.1, 0.03])
@pytest.mark.parametrize("peak", [1.0, 8.0])
def test_step_bounds_the_error(step: float, peak: float) -> None:
    field = GaussianField(peak, 0.5, 0.7, step)
    rays, o, d = rays_towards(np.zeros(3), 0.5, 256)
    actual = numbers(march(PosedField(field), rays, 0.0))
    expected = quadrature([(field, Pose.identity())], o, d)
    near, far = box_interval(o, d, Pose.identity(), field.half)
    length = far - near
    s0, s1, s2 = field.sigma
    e = step**2 * (length * s2 / 24 + s1 / 4)

    def bound(l0: Any, l1: float, l2: float) -> np.ndarray:
        local = l1 * s0 * (1 + s0 * step) / 12 + l2 / 8
        return e * (l0 + length * l1) + step**2 * local

    limits = [bound(*field.colour)[:, None], e, bound(far, 1.0, 0.0)]
    for a, b, limit in zip(actual, expected, limits, strict=True):
        error = np.abs(a - b)
        assert np.all(error <= limit + 1e-6)
        assert np.max(error / limit) > 1e-3  # the bound means something


@pytest.mark.parametrize("step", [0.2, 0.07, 0.03])
def test_step_bounds_the_error_at_kinks(step: float) -> None:
    # Along x, the logarithm of the density and the raw colour run straight from vertex
    # to vertex.
    rng = np.random.default_rng(4)
    field = GridField(GridLayout(1, 9, 9), -np.ones(3), np.ones(3), step_m=step)
    planes = np.sort(np.unique(small.vertices(field)[:, 0]))
    height = rng.uniform(-1.5, 1.0, len(planes))
    raw = np.interp(small.vertices(field)[:, 0], planes, height)
    field.set_parameter("density", raw.astype(np.float32))
    colours = rng.uniform(-3, 3, (len(planes), 3))
    shown = [np.interp(small.vertices(field)[:, 0], planes, c) for c in colours.T]
    field.set_parameter("texture", np.stack(shown, 1).astype(np.float32))

    start = rng.uniform(2, 3, 32).astype(np.float32)  # the lattice starts at the eye
    origin = mi.Point3f(-mi.Float(start), 0.13, -0.4)
    integrals = march(PosedField(field), Rays(origin, mi.Vector3f(1, 0, 0)), 0.0)
    inner = planes[(planes > -1) & (planes < 1)]
    x = np.concatenate([[-1], inner, [1]])
    log = np.interp(x, planes, height)
    slope = np.diff(log) / np.diff(x)
    density = field.density_scale * np.exp(log)
    tau = (np.diff(density) / slope).sum()  # of exp(a + b x)
    left, right = slope * density[:-1], slope * density[1:]
    variation = np.abs(right - left).sum() + np.abs(left[1:] - right[:-1]).sum()
    limit = step**2 * variation / 8
    error = np.abs(integrals.opacity.numpy().astype(float) + np.expm1(-tau))
    assert np.all(error <= limit + 1e-6)
    assert np.max(error) > 1e-3 * limit

    fine = np.linspace(-1, 1, 200_001)
    sigma = field.density_scale * np.exp(np.interp(fine, planes, height))
    through = np.exp(-cumulative_trapezoid(sigma, fine, initial=0))
    s0, s1 = sigma.max(), np.abs(np.gradient(sigma, fine)).max()
    e = limit + step**2 * s1 / 4
    for radiance, raw in zip(integrals.radiance.numpy(), colours.T, strict=True):
        colour = small.sigmoid_to_linear(np.interp(fine, planes, raw))
        slope = np.diff(colour) / np.diff(fine)
        l0, l1, turns = colour.max(), np.abs(slope).max(), np.abs(np.diff(slope)).sum()
        local = s0 * (l1 * (1 + s0 * step) / 12 + turns / 4)
        most = e * (l0 + 2 * l1) + step**2 * local
        error = np.abs(radiance - np.trapezoid(sigma * through * colour, fine))
        assert np.all(error <= most + 1e-6)
        assert np.max(error) > 1e-4 * most


@pytest.mark.parametrize("stop", [0.3, 0.03, 1e-3])
@pytest.mark.parametrize("composite", [DepthComposite(), InterleavedComposite()])
def test_stop_bounds_the_error(stop: float, composite: Any) -> None:
    shifted = Pose(np.eye(3), np.array([0.5, 0.2, 0.1]))
    posed = [
        PosedField(GaussianField(9.0, 0.5, 1.0, 0.02)),
        PosedField(GaussianField(5.0, 0.6, 1.0, 0.02), shifted),
    ]
    rays, o, d = rays_towards(np.zeros(3), 0.5, 256)
    if isinstance(composite, DepthComposite):
        posed = posed[:1]  # the bound is that of one march
    exact = numbers(composite.render(posed, rays, 0.0).total)
    ended = numbers(composite.render(posed, rays, stop).total)
    far = np.max([box_interval(o, d, item.pose, 1.0)[1] for item in posed], axis=0)
    for a, b, most in zip(exact, ended, (0.9, 1.0, far), strict=True):
        lost = a - b
        assert np.all(lost >= -1e-6)
        assert np.all(lost <= stop * most + 1e-6)
        assert np.max(lost / most) > 0.05 * stop
