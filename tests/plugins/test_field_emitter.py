"""The emitter as a light: emitter sampling against BSDF sampling, both sides."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.variants import later

from mi_nerfattack.fields import save_field

WIDTH, HEIGHT = 8, 6
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
BY_BSDF = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
BY_EMITTER = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
BOTH = {"type": "path", "max_depth": 2}
SHAPES = {"cube": 1.0, "sphere": 3**0.5}  # size around the box [-1, 1]^3


@pytest.fixture(params=["llvm_ad_rgb", *later("llvm_ad_spectral")])
def grid(request, tmp_path: Path, rng: np.random.Generator, no_variant_left) -> Path:
    """A file with a bright blob in [-1, 1]^3."""
    mi.set_variant(request.param)
    save_field(tmp_path / "grid.safetensors", small.blob(rng, peak=4, step_m=0.2))
    return tmp_path / "grid.safetensors"


def film() -> dict[str, Any]:
    """Describe a film without noise across pixels."""
    size = {"width": WIDTH, "height": HEIGHT, "pixel_format": "rgb"}
    return {"type": "hdrfilm", "rfilter": {"type": "box"}, **size}


def lamp(path: Path, shape: str) -> dict[str, Any]:
    """Describe a closed shape whose emitter holds the field."""
    field = {"type": "grid_field", "filename": str(path)}
    emitter = {"type": "field_emitter", "object": field}
    place = mi.ScalarTransform4f().scale(1.01 * SHAPES[shape])
    return {"type": shape, "to_world": place, "bsdf": BLACK, "emitter": emitter}


def scene(path: Path, shape: str, integrator: dict, inside: bool) -> mi.Scene:
    """Load a diffuse surface lit by the emitter, outside or inside of its shape."""
    t = mi.ScalarTransform4f()
    if inside:
        lit = {"type": "sphere", "to_world": t.translate([0.7, 0, 0]).scale(0.25)}
        view = t.look_at([0.1, 0.3, 0.9], [0.7, 0, 0], [0, 0, 1])
        fov = 25
    else:
        lit = {"type": "rectangle", "to_world": t.translate([0, 0, -2]).scale(2)}
        view = t.look_at([6, 2, 0], [0, 0, -2], [0, 0, 1])
        fov = 20
    sensor = {"type": "perspective", "fov": fov, "to_world": view, "film": film()}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"hide_emitters": True, **integrator},
            "sensor": sensor,
            "lamp": lamp(path, shape),
            "lit": {**lit, "bsdf": {"type": "diffuse"}},
        },
        parallel=False,
    )


def estimate(loaded: mi.Scene, spp: int, runs: int = 16) -> tuple[np.ndarray, Any]:
    """Return the mean image over seeds and its standard error."""
    images = [np.array(mi.render(loaded, spp=spp, seed=k)) for k in range(runs)]
    return np.mean(images, 0), np.std(images, 0, ddof=1) / np.sqrt(runs)


@pytest.mark.parametrize(
    ("integrator", "shape", "inside"),
    [
        (BOTH, "cube", False),
        (BY_EMITTER, "sphere", False),
        (BOTH, "sphere", True),
        (BY_EMITTER, "cube", True),
    ],
    ids=["path cube", "emitter sphere", "path in sphere", "emitter in cube"],
)
def test_emitter_sampling_agrees_with_bsdf_sampling(
    grid: Path, shape: str, integrator: dict, inside: bool
) -> None:
    expected, noise = estimate(scene(grid, shape, BY_BSDF, inside), 512)
    found, other = estimate(scene(grid, shape, integrator, inside), 512)
    assert expected.mean() > 1e-3
    error = (found - expected) / np.sqrt(noise**2 + other**2 + 1e-12)
    # Student's t with about 30 degrees of freedom, over 144 values.
    assert np.abs(error).max() < 6
    # Channels share their noise, pixels do not.
    bound = 5 * np.sqrt((noise**2 + other**2).mean() / (WIDTH * HEIGHT))
    assert abs(found.mean() - expected.mean()) < bound < 0.15 * expected.mean()


@pytest.mark.parametrize(
    ("shape", "eye"), [("cube", (3.0, 0.4, 0.2)), ("sphere", (0.3, 0.2, 0.1))]
)
def test_sampled_directions_carry_their_density(grid: Path, shape: str, eye) -> None:
    # sum(radiance / density) over samples is the irradiance of a whole sphere.
    loaded = scene(grid, shape, BOTH, False)
    (emitter,) = loaded.emitters()
    rng = np.random.default_rng(0)
    it = dr.zeros(mi.Interaction3f, 1 << 19)
    it.p = mi.Point3f(*eye)
    if mi.is_spectral:
        it.wavelengths = mi.Spectrum(450.0, 500.0, 550.0, 600.0)
    sample = mi.Point2f(rng.random((2, 1 << 19)).astype(np.float32))
    ds, weight = emitter.sample_direction(it, sample)
    density = emitter.pdf_direction(it, ds)
    np.testing.assert_allclose(density, ds.pdf, rtol=1e-3)
    value = emitter.eval_direction(it, ds)
    product = np.array(weight) * np.array(ds.pdf)
    np.testing.assert_allclose(product, np.array(value), rtol=1e-3, atol=1e-6)

    # Directions all around see the same light, where the shape is met.
    around = mi.warp.square_to_uniform_sphere(sample)
    ray = mi.Ray3f(it.p, around)
    ray.wavelengths = it.wavelengths
    si = loaded.ray_intersect(ray)
    seen = np.array(si.emitter(loaded).eval(si)) * 4 * np.pi
    # From outside, a line meets a convex shape twice, and both points are sampled.
    front = np.array(dr.dot(ds.n, ds.d)) < 0 if max(eye) > 1 else 1
    found = np.array(weight) * front
    noise = np.sqrt((seen.var(1) + found.var(1)) / seen.shape[1])
    assert (noise < 0.05 * seen.mean(1)).all()
    assert (np.abs(found.mean(1) - seen.mean(1)) < 4 * noise).all()


def test_light_tracing_from_the_emitter_is_refused(grid: Path) -> None:
    (emitter,) = scene(grid, "cube", BOTH, False).emitters()
    with pytest.raises(NotImplementedError, match="field_emitter: cannot trace light"):
        emitter.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
