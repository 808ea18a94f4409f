"""Order of convergence, and the bounds that `march` documents."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.exact_fields import GaussianField, box_interval, quadrature, rays_towards
from scipy.integrate import cumulative_trapezoid

from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import DepthComposite
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

pytestmark = pytest.mark.usefixtures("variant")


def numbers(seen: March) -> list[np.ndarray]:
    arrays = (seen.radiance, seen.opacity, seen.moment)
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
        seen = InterleavedComposite().render(posed, rays, 0.0).total
        if not overlap:
            seen = march(posed[0], rays, 0.0)
        return np.array(
            [
                np.sqrt(np.mean((a - b) ** 2))
                for a, b in zip(numbers(seen), expected, strict=True)
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
    seen = numbers(march(PosedField(field), rays, 0.0))
    expected = quadrature([(field, Pose.identity())], o, d)
    near, far = box_interval(o, d, Pose.identity(), field.half)
    length = far - near
    s0, s1, s2 = field.sigma
    e = step**2 * (length * s2 / 24 + s1 / 4)

    def bound(l0: Any, l1: float, l2: float) -> np.ndarray:
        local = l1 * s0 * (1 + s0 * step) / 12 + l2 / 8
        return e * (l0 + length * l1) + step**2 * local

    limits = [bound(*field.colour)[:, None], e, bound(far, 1.0, 0.0)]
    for a, b, limit in zip(seen, expected, limits, strict=True):
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
    seen = march(PosedField(field), Rays(origin, mi.Vector3f(1, 0, 0)), 0.0)
    inner = planes[(planes > -1) & (planes < 1)]
    x = np.concatenate([[-1], inner, [1]])
    log = np.interp(x, planes, height)
    slope = np.diff(log) / np.diff(x)
    density = field.density_scale * np.exp(log)
    tau = (np.diff(density) / slope).sum()  # of exp(a + b x)
    left, right = slope * density[:-1], slope * density[1:]
    variation = np.abs(right - left).sum() + np.abs(left[1:] - right[:-1]).sum()
    limit = step**2 * variation / 8
    error = np.abs(seen.opacity.numpy().astype(float) + np.expm1(-tau))
    assert np.all(error <= limit + 1e-6)
    assert np.max(error) > 1e-3 * limit

    fine = np.linspace(-1, 1, 200_001)
    sigma = field.density_scale * np.exp(np.interp(fine, planes, height))
    through = np.exp(-cumulative_trapezoid(sigma, fine, initial=0))
    s0, s1 = sigma.max(), np.abs(np.gradient(sigma, fine)).max()
    e = limit + step**2 * s1 / 4
    for found, raw in zip(seen.radiance.numpy(), colours.T, strict=True):
        colour = small.sigmoid_to_linear(np.interp(fine, planes, raw))
        slope = np.diff(colour) / np.diff(fine)
        l0, l1, turns = colour.max(), np.abs(slope).max(), np.abs(np.diff(slope)).sum()
        local = s0 * (l1 * (1 + s0 * step) / 12 + turns / 4)
        most = e * (l0 + 2 * l1) + step**2 * local
        error = np.abs(found - np.trapezoid(sigma * through * colour, fine))
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
