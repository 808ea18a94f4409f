"""Images of fields through Mitsuba: integrator, emitter, surfaces, derivatives."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small

from mi_nerfattack.fields import load_field, save_field
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 16, 12
OUTSIDE, INSIDE = "3,1,.5", "-.4,.2,.1"
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
LIGHT = '<emitter type="area"><rgb name="radiance" value="0,2,0"/></emitter>'
VIEWS = pytest.mark.parametrize("eye", [OUTSIDE, INSIDE], ids=["outside", "inside"])


def volume(path: Path, kind: str = "grid_field", name: str = "object") -> str:
    """Write a volume as XML."""
    filename = f'<string name="filename" value="{path}"/>'
    return f'<volume type="{kind}" id="{name}">{filename}</volume>'


def scene(integrator: str, world: str = "", eye: str = OUTSIDE) -> mi.Scene:
    """Load a scene of 16 x 12 pixels that looks at the origin."""
    return mi.load_string(
        '<scene version="3.0.0"><sensor type="perspective">'
        '<float name="fov" value="60"/><transform name="to_world">'
        f'<lookat origin="{eye}" target="0,0,0" up="0,0,1"/></transform>'
        f'<film type="hdrfilm"><integer name="width" value="{WIDTH}"/>'
        f'<integer name="height" value="{HEIGHT}"/><rfilter type="box"/>'
        '<string name="pixel_format" value="rgb"/></film></sensor>'
        f"{integrator}{world}</scene>",
        parallel=False,
    )


def fields(inside: str) -> str:
    """Write a field_integrator with AOVs as XML; stop 0 makes it exact."""
    more = '<float name="stop" value="0"/><boolean name="aovs" value="true"/>'
    return f'<integrator type="field_integrator">{more}{inside}</integrator>'


def emitter(inside: str) -> str:
    """Write a cube with a field_emitter, a little larger than the fields' box."""
    return (
        '<shape type="cube"><transform name="to_world"><scale value="1.01"/>'
        f'</transform>{BLACK}<emitter type="field_emitter"><float name="stop" '
        f'value="0"/>{inside}</emitter></shape>'
    )


def rectangle(x: float, half: float = 9.0) -> str:
    """Write a green light in the plane of one x that faces +x."""
    return (
        f'<shape type="rectangle"><transform name="to_world"><scale value="{half}"/>'
        f'<rotate y="1" angle="90"/><translate x="{x}"/></transform>{LIGHT}{BLACK}'
        "</shape>"
    )


def render(loaded: mi.Scene, spp: int = 1, seed: int = 0) -> np.ndarray:
    """Render (height, width, channels)."""
    return np.array(mi.render(loaded, spp=spp, seed=seed))


@pytest.fixture
def grid(tmp_path: Path, variant: str, rng: np.random.Generator) -> Path:
    path = tmp_path / "grid.safetensors"
    save_field(path, small.blob(rng, step_m=0.03))
    return path


@pytest.fixture
def ngp(tmp_path: Path, variant: str) -> Path:
    path = tmp_path / "ngp.safetensors"
    field = small.small_ngp()
    field.step_m = 0.02
    save_field(path, field)
    return path


# Values


@VIEWS
def test_integrator_shows_the_march(grid: Path, eye: str) -> None:
    loaded = scene(fields(volume(grid)), eye=eye)
    image = render(loaded)
    ray = small.first_rays(loaded)
    posed = PosedField(load_field(grid))
    seen = march(posed, Rays(ray.o, ray.d), 0.0)
    expected = [*seen.radiance, seen.opacity, seen.depth]
    expected += [*seen.radiance, seen.opacity, seen.depth]
    assert image.shape == (HEIGHT, WIDTH, 10)
    for channel, values in enumerate(expected):
        found = image[..., channel].ravel()
        np.testing.assert_allclose(found, values.numpy(), rtol=1e-3, atol=1e-5)


@VIEWS
@pytest.mark.parametrize("integrator", ["path", "direct"])
def test_emitter_shows_what_the_integrator_shows(grid, ngp, eye, integrator) -> None:
    inside = volume(grid) + volume(ngp, "ngp_field", "scene")
    one = scene(fields(inside), eye=eye)
    other = scene(f'<integrator type="{integrator}"/>', emitter(inside), eye)
    a, b = render(one)[..., :3], render(other)[..., :3]
    # Rays that pass by the cube see the sky of the integrator alone.
    met = b.sum(-1) > 0
    assert a[met].max() > 0.05
    # From outside, the steps count from the surface instead of the camera.
    error = 1e-4 if eye == INSIDE else 3e-3
    np.testing.assert_allclose(a[met], b[met], rtol=1e-3, atol=error)


def test_emitter_lights_other_surfaces(tmp_path: Path) -> None:
    # An opaque homogeneous box is a lamp of one radiance, as an area light is.
    path = tmp_path / "lamp.safetensors"
    save_field(path, small.homogeneous(1e4))
    radiance = float(small.sigmoid_to_linear(np.array(0.3)))
    floor = (
        '<shape type="rectangle"><transform name="to_world"><scale value="6"/>'
        '<translate z="-2"/></transform><bsdf type="diffuse"/></shape>'
    )
    stock = (
        f'<shape type="cube">{BLACK}<emitter type="area"><rgb name="radiance" '
        f'value="{radiance}"/></emitter></shape>'
    )
    eye = "5,1,2"
    own = emitter(volume(path)).replace('<scale value="1.01"/>', "")
    images = [
        render(scene('<integrator type="direct"/>', floor + lamp, eye), spp=64)
        for lamp in (own, stock)
    ]
    lit = (images[1] > 0).any(-1) & (images[1] < 0.9 * radiance).all(-1)
    assert lit.mean() > 0.3
    expected = images[1][lit].mean()
    np.testing.assert_allclose(images[0][lit].mean(), expected, rtol=0.03)


def test_surface_in_front_hides_the_field(grid: Path) -> None:
    image = render(scene(fields(volume(grid)), rectangle(2.0)))
    assert (image[..., 3] == 0).all() and (image[..., 4] == np.inf).all()
    assert (image[..., :3] == 0).all()  # without a nested integrator


def test_sky_does_not_lie_behind_surfaces(ngp: Path) -> None:
    inside = fields(volume(ngp, "ngp_field", "scene"))
    walled = render(scene(inside, rectangle(-2.0, 99.0)))
    np.testing.assert_allclose(walled[..., :3], walled[..., 5:8], atol=1e-5)
    assert walled[..., 3].max() > 0.1


def test_jitter_keeps_the_mean(grid: Path) -> None:
    fixed = render(scene(fields(volume(grid))), spp=64)
    jitter = '<boolean name="jitter" value="true"/>'
    noisy = render(scene(fields(jitter + volume(grid))), spp=64)
    assert not np.array_equal(fixed, noisy)
    a, b = fixed[..., :4].mean((0, 1)), noisy[..., :4].mean((0, 1))
    np.testing.assert_allclose(b, a, rtol=0.02)


@pytest.mark.usefixtures("no_variant_left")
def test_monochromatic_variant_shows_luminance(grid: Path) -> None:
    colour = render(scene(fields(volume(grid))))
    mi.set_variant("llvm_ad_mono")
    mono = render(scene(fields(volume(grid))))
    expected = colour[..., :3] @ [0.212671, 0.715160, 0.072169]
    np.testing.assert_allclose(mono[..., 0], expected, rtol=1e-3, atol=1e-4)
