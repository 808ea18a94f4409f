"""The integrator with every film, filter, crop and sensor; the emitter as a light.

From inside its shape, `field_emitter` under the stock `path` marches the same rays
from the same origins: the stock integrator says what the film should show.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import Derivatives, key_of, later
from support.worlds import fields as small
from support.worlds.fields import T, load

from mi_nerfattack.fields import load_field, save_field
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")

CROP = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 7, "crop_height": 5}
VIEW = {"eye": (-0.4, 0.2, 0.1), "target": (0.3, 0, 0), "fov": 70}
SIZE = {"width": 14, "height": 9}
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}


@pytest.fixture
def grid(tmp_path: Path, variant: str, rng: np.random.Generator) -> dict[str, Any]:
    """A blob in [-1, 1]^3 as a volume."""
    save_field(tmp_path / "grid.safetensors", small.blob(rng, step_m=0.05))
    return {"type": "grid_field", "filename": str(tmp_path / "grid.safetensors")}


def scene(grid: dict, entries: dict | None = None, **film: Any) -> mi.Scene:
    """Load a scene with a field_integrator."""
    nested = {"object": grid, **(entries or {})}
    return load(nested, **{**VIEW, **SIZE, **film})


def stock(grid: dict, **film: Any) -> mi.Scene:
    """Load the same scene for the stock path tracer."""
    lamp = {"type": "field_emitter", "stop": 0.0, "object": grid}
    cube = {"type": "cube", "to_world": T().scale(1.01), "bsdf": BLACK}
    path = {"type": "path", "max_depth": 1}
    return load(path, {"cube": {**cube, "lamp": lamp}}, **VIEW, **SIZE, **film)


def shown(loaded: mi.Scene, spp: int = 2, **options: Any) -> np.ndarray:
    return np.array(mi.render(loaded, spp=spp, **options))


def check_derivatives(loaded, rng, channels: int, **view: Any) -> None:
    """Compare the derivatives of the first channels of an image by the colours."""
    params = mi.traverse(loaded)
    key = key_of(params, "colour")

    def output() -> mi.TensorXf:
        seeds = {"seed": 9, "seed_grad": 3}
        if not dr.grad_enabled(params[key]):
            seeds = {"seed": 3}
        return mi.render(loaded, params, spp=2, **seeds, **view)[..., :channels]

    derivatives = Derivatives(params, key, output)
    derivatives.check([rng.normal(0, 1, derivatives.base.shape)])


@pytest.mark.parametrize("eye", [(3, 1, 0.5), (-0.4, 0.2, 0.1)], ids=["out", "in"])
def test_integrator_shows_the_march(grid, eye) -> None:
    loaded = scene(grid, {"aovs": True}, eye=eye)
    image = shown(loaded, 1, seed=0)
    ray = small.first_rays(loaded)
    integrals = march(PosedField(load_field(grid["filename"])), Rays(ray.o, ray.d), 0.0)
    expected = 2 * [*integrals.radiance, integrals.opacity, integrals.depth]
    assert image.shape == (9, 14, 10)
    for channel, values in enumerate(expected):
        pixels = image[..., channel].ravel()
        np.testing.assert_allclose(pixels, values.numpy(), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("rfilter", "window"),
    [("box", CROP), ("gaussian", CROP), ("lanczos", {})],
    ids=["box crop", "gaussian crop", "lanczos"],
)
def test_filters_and_crops_are_those_of_the_path_tracer(
    grid, rng, rfilter, window
) -> None:
    film = {"rfilter": {"type": rfilter}, "sample_border": rfilter == "gaussian"}
    loaded = scene(grid, **film, **window)
    actual, expected = (
        shown(x, 3, seed=5) for x in (loaded, stock(grid, **film, **window))
    )
    assert expected.shape[:2] == ((5, 7) if window else (9, 14))
    assert expected.std() > 0.01
    np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-4)
    check_derivatives(loaded, rng, 3)


@pytest.mark.parametrize(
    ("pixel_format", "channels"), [("luminance_alpha", 2), ("rgba", 4), ("xyz", 3)]
)
def test_pixel_formats(grid, pixel_format: str, channels: int, rng) -> None:
    loaded = scene(grid, pixel_format=pixel_format)
    image, expected = shown(loaded), shown(stock(grid, pixel_format=pixel_format))
    assert image.shape[2] == channels
    if pixel_format.endswith("a"):
        # The path tracer's is 1 on the whole cube, ours the opacity.
        marched = scene(grid, {"aovs": True}, pixel_format=pixel_format)
        expected[..., -1] = shown(marched)[..., channels]
    np.testing.assert_allclose(image, expected, atol=1e-4)
    check_derivatives(loaded, rng, channels)


def test_every_sensor_of_a_scene(grid, rng) -> None:
    films = {}, {"eye": (2.5, 0.5, 1)}, {"rfilter": {"type": "gaussian"}, **CROP}
    alone = [scene(grid, {"aovs": True}, **film) for film in films]
    sensors = {f"sensor_{i}": x.sensors()[0] for i, x in enumerate(alone)}
    integrator = {"type": "field_integrator", "stop": 0.0, "aovs": True, "object": grid}
    together = {"type": "scene", "i": integrator, **sensors}
    loaded = mi.load_dict(together, parallel=False)
    for index, one in enumerate(alone):
        expected = shown(one, seed=1)[..., :4]
        for sensor in (index, loaded.sensors()[index]):
            image = shown(loaded, sensor=sensor, seed=1)[..., :4]
            # filters splat in the order of the threads
            np.testing.assert_allclose(image, expected, atol=1e-6)
    check_derivatives(loaded, rng, 3, sensor=2)


def test_jitter_keeps_the_mean(grid) -> None:
    fixed, noisy = (shown(scene(grid, {"jitter": x}), 64) for x in (False, True))
    assert not np.array_equal(fixed, noisy)
    np.testing.assert_allclose(noisy.mean((0, 1)), fixed.mean((0, 1)), rtol=0.02)


def test_a_thin_lens_and_a_motion_blurred_sensor_render(grid) -> None:
    sharp = shown(scene(grid, {"aovs": True}, eye=(3, 1, 0.5)), 64)[..., :4]
    lens = {
        "type": "thinlens",
        "fov": 70,
        "to_world": T().look_at([3, 1, 0.5], [0.3, 0, 0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "pixel_format": "rgb", **SIZE},
        **{"aperture_radius": 0.4, "focus_distance": 1.0, "shutter_close": 1.0},
    }
    loaded = load({"object": grid, "aovs": True}, {"camera": lens})
    blurred = shown(loaded, 64)[..., :4]
    assert np.isfinite(blurred).all()
    # Out of focus, the blob's light spreads.
    assert blurred[..., 3].max() < sharp[..., 3].max()
    assert (blurred[..., 3] > 0).sum() >= (sharp[..., 3] > 0).sum()


# The emitter as a light: emitter sampling against BSDF sampling, both sides

WIDTH, HEIGHT = 8, 6
BY_BSDF = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
BY_EMITTER = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
BOTH = {"type": "path", "max_depth": 2}
SHAPES = {"cube": 1.0, "sphere": 3**0.5}  # size around the box [-1, 1]^3


@pytest.fixture(params=["llvm_ad_rgb", *later("llvm_ad_spectral")])
def bright(request, tmp_path: Path, rng: np.random.Generator, no_variant_left) -> Path:
    """A file with a bright blob in [-1, 1]^3."""
    mi.set_variant(request.param)
    save_field(tmp_path / "bright.safetensors", small.blob(rng, peak=4, step_m=0.2))
    return tmp_path / "bright.safetensors"


def lit_scene(path: Path, shape: str, integrator: dict, inside: bool) -> mi.Scene:
    """Load a diffuse surface lit by the emitter, outside or inside of its shape."""
    field = {"type": "grid_field", "filename": str(path)}
    lamp = {"type": shape, "to_world": T().scale(1.01 * SHAPES[shape]), "bsdf": BLACK}
    lamp["emitter"] = {"type": "field_emitter", "object": field}
    lit = {"type": "rectangle", "to_world": T().translate([0, 0, -2]).scale(2)}
    view = {"eye": (6, 2, 0), "target": (0, 0, -2), "fov": 20}
    if inside:
        lit = {"type": "sphere", "to_world": T().translate([0.7, 0, 0]).scale(0.25)}
        view = {"eye": (0.1, 0.3, 0.9), "target": (0.7, 0, 0), "fov": 25}
    world = {"lamp": lamp, "lit": {**lit, "bsdf": {"type": "diffuse"}}}
    seeing = {"hide_emitters": True, **integrator}
    return load(seeing, world, **view, width=WIDTH, height=HEIGHT)


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
    bright: Path, shape: str, integrator: dict, inside: bool
) -> None:
    expected, noise = estimate(lit_scene(bright, shape, BY_BSDF, inside), 512)
    actual, other = estimate(lit_scene(bright, shape, integrator, inside), 512)
    assert expected.mean() > 1e-3
    error = (actual - expected) / np.sqrt(noise**2 + other**2 + 1e-12)
    # Student's t with about 30 degrees of freedom, over 144 values.
    assert np.abs(error).max() < 6
    # Channels share their noise, pixels do not.
    bound = 5 * np.sqrt((noise**2 + other**2).mean() / (WIDTH * HEIGHT))
    assert abs(actual.mean() - expected.mean()) < bound < 0.15 * expected.mean()


@pytest.mark.parametrize(
    ("shape", "eye"), [("cube", (3.0, 0.4, 0.2)), ("sphere", (0.3, 0.2, 0.1))]
)
def test_sampled_directions_carry_their_density(bright: Path, shape: str, eye) -> None:
    # sum(radiance / density) over samples is the irradiance of a whole sphere.
    loaded = lit_scene(bright, shape, BOTH, False)
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
    from_sphere = np.array(si.emitter(loaded).eval(si)) * 4 * np.pi
    # From outside, a line meets a convex shape twice, and both points are sampled.
    front = np.array(dr.dot(ds.n, ds.d)) < 0 if max(eye) > 1 else 1
    from_emitter = np.array(weight) * front
    noise = np.sqrt((from_sphere.var(1) + from_emitter.var(1)) / from_sphere.shape[1])
    assert (noise < 0.05 * from_sphere.mean(1)).all()
    assert (np.abs(from_emitter.mean(1) - from_sphere.mean(1)) < 4 * noise).all()


def test_light_tracing_from_the_emitter_is_refused(bright: Path) -> None:
    (emitter,) = lit_scene(bright, "cube", BOTH, False).emitters()
    with pytest.raises(NotImplementedError, match="field_emitter: "):
        emitter.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
