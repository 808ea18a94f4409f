"""The integrator with every film, filter, crop and sensor that Mitsuba has.

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
from helpers import small_fields as small
from helpers.derivatives import Derivatives

from mi_nerfattack.fields import save_field

pytestmark = pytest.mark.usefixtures("variant")

CROP = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 7, "crop_height": 5}
FILMS = pytest.mark.parametrize(
    ("rfilter", "window"),
    [("box", {}), ("box", CROP), ("gaussian", CROP), ("lanczos", {})],
    ids=["box", "box crop", "gaussian crop", "lanczos"],
)
EYE = (-0.4, 0.2, 0.1)
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}


@pytest.fixture
def grid(tmp_path: Path, variant: str, rng: np.random.Generator) -> dict[str, Any]:
    """A blob in [-1, 1]^3 as a volume."""
    save_field(tmp_path / "grid.safetensors", small.blob(rng, step_m=0.05))
    return {"type": "grid_field", "filename": str(tmp_path / "grid.safetensors")}


def camera(eye=EYE, rfilter: str = "box", **film: Any) -> dict[str, Any]:
    """Describe a sensor of 14 x 9 pixels at a point, looking at the origin."""
    view = mi.ScalarTransform4f().look_at(list(eye), [0.3, 0, 0], [0, 0, 1])
    whole = {"type": "hdrfilm", "width": 14, "height": 9, "pixel_format": "rgb"}
    described = {**whole, "rfilter": {"type": rfilter}, **film}
    return {"type": "perspective", "fov": 70, "to_world": view, "film": described}


def fields(*sensors: dict, stop: float = 0.0, **nested: Any) -> mi.Scene:
    """Load a scene with a field_integrator and sensors."""
    integrator = {"type": "field_integrator", "stop": stop, **nested}
    views = {f"sensor_{i}": sensor for i, sensor in enumerate(sensors)}
    return mi.load_dict({"type": "scene", "i": integrator, **views}, parallel=False)


def stock(sensor: dict, grid: dict) -> mi.Scene:
    """Load the same scene for the stock path tracer."""
    lamp = {"type": "field_emitter", "stop": 0.0, "object": grid}
    place = mi.ScalarTransform4f().scale(1.01)
    cube = {"type": "cube", "to_world": place, "bsdf": BLACK, "lamp": lamp}
    path = {"type": "path", "max_depth": 1}
    return mi.load_dict(
        {"type": "scene", "i": path, "cube": cube, "s": sensor}, parallel=False
    )


@FILMS
def test_filters_and_crops_are_those_of_the_path_tracer(grid, rfilter, window) -> None:
    sensor = camera(rfilter=rfilter, sample_border=rfilter == "gaussian", **window)
    found = np.array(mi.render(fields(sensor, object=grid), spp=3, seed=5))
    expected = np.array(mi.render(stock(sensor, grid), spp=3, seed=5))
    assert found.shape == (*expected.shape[:2], 3)
    assert expected.shape[:2] == ((5, 7) if window else (9, 14))
    assert expected.std() > 0.01
    np.testing.assert_allclose(found[..., :3], expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("rfilter", "window"), [("box", {}), ("lanczos", CROP)])
def test_derivatives_pass_through_filters_and_crops(grid, rfilter, window, rng) -> None:
    loaded = fields(camera(rfilter=rfilter, **window), object=grid)
    found = derivatives(loaded, 3, 3)
    found.check([rng.normal(0, 1, found.base.shape)])


def derivatives(loaded: mi.Scene, channels: int, spp: int, **view) -> Derivatives:
    """Differentiate the first channels of an image by the colours."""
    params = mi.traverse(loaded)
    key = next(key for key in params.keys() if key.endswith("colour"))  # noqa: SIM118

    def output() -> mi.TensorXf:
        seeds = {"seed": 9, "seed_grad": 3}
        if not dr.grad_enabled(params[key]):
            seeds = {"seed": 3}
        return mi.render(loaded, params, spp=spp, **seeds, **view)[..., :channels]

    return Derivatives(params, key, output)


@pytest.mark.parametrize(
    ("pixel_format", "channels"),
    [("luminance_alpha", 2), ("rgba", 4), ("xyz", 3)],
)
def test_pixel_formats(grid, pixel_format: str, channels: int, rng) -> None:
    sensor = camera(pixel_format=pixel_format)
    loaded = fields(sensor, object=grid)
    image = np.array(mi.render(loaded, spp=2))
    expected = np.array(mi.render(stock(sensor, grid), spp=2))
    assert image.shape[2] == channels
    if pixel_format.endswith("a"):
        # The path tracer's is 1 on the whole cube, ours the opacity.
        marched = fields(sensor, object=grid, aovs=True)
        expected[..., -1] = np.array(mi.render(marched, spp=2))[..., channels]
    np.testing.assert_allclose(image, expected, atol=1e-4)
    found = derivatives(loaded, channels, 2)
    found.check([rng.normal(0, 1, found.base.shape)])


def test_every_sensor_of_a_scene(grid, rng) -> None:
    views = [camera(), camera((2.5, 0.5, 1)), camera((0, -3, 0.5), "gaussian", **CROP)]
    loaded = fields(*views, object=grid, aovs=True)
    for index, view in enumerate(views):
        alone = np.array(mi.render(fields(view, object=grid, aovs=True), spp=2, seed=1))
        for sensor in (index, loaded.sensors()[index]):
            image = np.array(mi.render(loaded, sensor=sensor, spp=2, seed=1))
            # filters splat in the order of the threads
            np.testing.assert_allclose(image[..., :4], alone[..., :4], atol=1e-6)
        found = derivatives(loaded, 3, 2, sensor=index)
        found.check([rng.normal(0, 1, found.base.shape)])


def test_a_thin_lens_and_a_motion_blurred_sensor_render(grid) -> None:
    sensor = camera((3, 1, 0.5))
    sharp = np.array(mi.render(fields(sensor, object=grid, aovs=True), spp=64))
    lens = {**sensor, "type": "thinlens", "aperture_radius": 0.4, "focus_distance": 1.0}
    timed = {**lens, "shutter_open": 0.0, "shutter_close": 1.0}
    blurred = np.array(mi.render(fields(timed, object=grid, aovs=True), spp=64))
    assert np.isfinite(blurred[..., :4]).all()
    # Out of focus, the blob's light spreads.
    assert blurred[..., 3].max() < sharp[..., 3].max()
    assert (blurred[..., 3] > 0).sum() >= (sharp[..., 3] > 0).sum()
