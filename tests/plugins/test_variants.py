"""Every plugin in every variant: primal, forward and backward mode.

Derivatives are compared with Richardson-extrapolated central differences along random
directions, rough and smooth, and with each other (dot-product identity).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.derivatives import Derivatives, images
from helpers.variants import MONO, RGB, SPECTRAL, later

from mi_nerfattack.fields import GridField, NGPField, save_field
from mi_nerfattack.render.lighting.spectrum import emission

pytestmark = pytest.mark.usefixtures("each_variant")

WIDTH, HEIGHT = 12, 8
#: For what does not meet the conversion of colours.
IN_RGB = pytest.mark.parametrize("each_variant", RGB, indirect=True)
IN_RGB_FIRST = pytest.mark.parametrize(
    "each_variant", [*RGB, *later(*SPECTRAL, *MONO)], indirect=True
)
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
NGP_PARAMETERS = ("table", "density_weights", "colour_weights", "sky")


@pytest.fixture(autouse=True)
def silent(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """Let what Dr.Jit logs fail the test."""
    yield
    assert capfd.readouterr().err == ""


def write(path: Path, field: Any) -> str:
    """Save a field and return its name."""
    save_field(path, field)
    return str(path)


@pytest.fixture
def grid(tmp_path: Path, each_variant: str, rng: np.random.Generator) -> str:
    """A file with a coloured blob in [-1, 1]^3."""
    return write(tmp_path / "grid.safetensors", small.blob(rng, step_m=0.1))


@pytest.fixture
def ngp(tmp_path: Path, each_variant: str) -> str:
    """A file with an NGP and a sky in [-1, 1]^3."""
    return write(tmp_path / "ngp.safetensors", smooth_ngp())


def smooth_ngp() -> NGPField:
    """Make an NGP whose rectifiers all stay open.

    Central differences are no reference where a step crosses a rectifier's kink.
    """
    field = small.small_ngp()
    rng = np.random.default_rng(0)
    for name, value in field.parameters().items():
        low, high = {"table": (0.2, 1), "sky": (-1, 1)}.get(name, (0, 0.15))
        fresh = rng.uniform(low, high, dr.width(value)).astype(np.float32)
        field.set_parameter(name, type(value)(fresh))
    return field


def volume(name: str, kind: str = "grid_field", **more: Any) -> dict[str, Any]:
    """Describe a volume."""
    return {"type": kind, "filename": name, **more}


def integrator(**more: Any) -> dict[str, Any]:
    """Describe a field_integrator; stop 0 makes it smooth."""
    return {"type": "field_integrator", "stop": 0.0, "jitter": True} | more


def scene(seeing: dict, eye=(3.0, 1.0, 0.5), target=(0, 0, 0), **more) -> mi.Scene:
    """Load a scene of 12 x 8 pixels that looks at a target."""
    view = mi.ScalarTransform4f().look_at(list(eye), list(target), [0, 0, 1])
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}
    film["pixel_format"] = "luminance" if mi.is_monochromatic else "rgb"
    film["rfilter"] = {"type": "box"}
    sensor = {"type": "perspective", "fov": 50, "to_world": view, "film": film}
    everything = {"type": "scene", "i": seeing, "sensor": sensor, **more}
    return mi.load_dict(everything, parallel=False)


def emitter(**fields: Any) -> dict[str, Any]:
    """Describe a cube with a field_emitter above a white floor."""
    t = mi.ScalarTransform4f()
    lamp = {"type": "field_emitter", "stop": 0.0, **fields}
    cube = {"type": "cube", "to_world": t.scale(1.01), "bsdf": BLACK, "e": lamp}
    floor = {"type": "rectangle", "to_world": t.translate([0, 0, -1.2]).scale(4)}
    return {"cube": cube, "floor": floor}


def problem(loaded: mi.Scene, name: str, spp: int = 2) -> Derivatives:
    """Differentiate the image of a scene by the parameter with a name."""
    params = mi.traverse(loaded)
    (key,) = [key for key in params.keys() if key.endswith(name)]  # noqa: SIM118
    return Derivatives(params, key, images(loaded, params, spp))


def directions(rng: np.random.Generator, field: GridField, shape) -> list[np.ndarray]:
    """Make a rough and a smooth random direction for a parameter of a grid.

    Colours have the vertices of the finest level, which come last.
    """
    place = small.vertices(field)
    place = place[field.levels()[-1].vertices] if len(shape) == 2 else place
    slope = rng.normal(0, 1, (3, int(np.prod(shape)) // len(place)))
    smooth = rng.normal(0, 1, slope.shape[1]) + place @ slope
    return [rng.normal(0, 1, shape), smooth.reshape(shape) / np.abs(smooth).max()]


def check_network(found: Derivatives, rng: np.random.Generator, name: str) -> None:
    """Compare the derivatives of an NGP along a rough direction.

    On CUDA the networks compute in half precision, so the comparison is loose there.
    """
    direction = rng.normal(0, 1, found.base.shape)
    if name == "sky":
        found.check([direction])
    elif mi.variant().startswith("cuda"):
        found.check([direction], 2e-2, 0.1)
    else:
        found.check([direction], 2e-2)


def field_of(loaded: mi.Scene, index: int = 0) -> Any:
    """Return a field of a scene's integrator."""
    return loaded.integrator().volumes[index].field


# Volumes


def interactions(rng: np.random.Generator) -> mi.Interaction3f:
    """Make 40 points in the box, at wavelengths that differ."""
    it = dr.zeros(mi.Interaction3f, 40)
    it.p = mi.Point3f(rng.uniform(-0.9, 0.9, (3, 40)).astype(np.float32))
    if mi.is_spectral:
        nm = rng.uniform(400, 700, (4, 40)).astype(np.float32)
        it.wavelengths = mi.Spectrum(nm)
    return it


def evaluated(loaded: mi.Volume, method: str, it: mi.Interaction3f) -> Any:
    """Return a function that evaluates a volume as a flat array."""
    if method == "eval_1":
        return lambda: loaded.eval_1(it)
    return lambda: dr.ravel(getattr(loaded, method)(it))


@pytest.mark.parametrize(
    ("name", "method"),
    [(name, method) for name in ("colour", "density") for method in ("eval", "eval_1")]
    + [("colour", "eval_3")],  # radiance does not depend on density
)
def test_grid_field(grid: str, rng, method: str, name: str) -> None:
    quantity = "radiance" if name == "colour" else "density"
    loaded = mi.load_dict(volume(grid, quantity=quantity))
    params, it = mi.traverse(loaded), interactions(rng)
    found = Derivatives(params, name, evaluated(loaded, method, it))
    field = loaded.field
    found.check(directions(rng, field, found.base.shape))


@pytest.mark.parametrize("name", NGP_PARAMETERS[:3])
def test_ngp_field(ngp: str, rng, name: str) -> None:
    loaded = mi.load_dict(volume(ngp, "ngp_field", quantity="radiance"))
    it = interactions(rng)
    found = Derivatives(mi.traverse(loaded), name, evaluated(loaded, "eval", it))
    check_network(found, rng, name)


@pytest.mark.parametrize("each_variant", RGB + SPECTRAL + MONO, indirect=True)
def test_spectra_of_volumes_are_those_of_their_colours(grid: str, rng) -> None:
    loaded = mi.load_dict(volume(grid, quantity="radiance"))
    it = interactions(rng)
    colour = loaded.eval_3(it)
    found = np.array(loaded.eval(it))
    if mi.is_monochromatic:
        expected = np.array(mi.luminance(mi.Color3f(colour)))[None]
    elif mi.is_spectral:
        lit = np.array(emission(mi.Color3f(colour), it.wavelengths))
        d65 = np.array([mi.cie_d65(nm) for nm in it.wavelengths])
        expected = lit / d65
    else:
        expected = np.array(colour)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


# The integrator


@pytest.mark.parametrize("composite", ["interleaved", "depth"])
@pytest.mark.parametrize("name", ["colour", "density"])
def test_field_integrator(grid: str, rng, name: str, composite: str) -> None:
    loaded = scene(integrator(object=volume(grid), composite=composite))
    found = problem(loaded, name)
    found.check(directions(rng, field_of(loaded), found.base.shape))


@pytest.mark.parametrize("name", NGP_PARAMETERS)
def test_field_integrator_with_an_ngp(ngp: str, rng, name: str) -> None:
    found = problem(scene(integrator(object=volume(ngp, "ngp_field"))), name)
    check_network(found, rng, name)


def test_field_integrator_over_a_nested_integrator(grid: str, rng) -> None:
    light = {"type": "constant"}
    nested = integrator(object=volume(grid), behind={"type": "prb"})
    loaded = scene(nested, light=light)
    found = problem(loaded, "density", 16)
    found.check(directions(rng, field_of(loaded), found.base.shape))


# The emitter


@pytest.mark.parametrize("eye", [(3, 2, 1), (0.4, 0.2, 0)], ids=["outside", "inside"])
def test_path_shows_what_the_integrator_shows(tmp_path, rng, eye) -> None:
    grid = write(tmp_path / "fine.safetensors", small.blob(rng, step_m=0.03))
    loaded = scene(integrator(object=volume(grid), jitter=False), eye)
    expected = images(loaded, {})().numpy()
    stock = scene({"type": "path"}, eye, cube=emitter(object=volume(grid))["cube"])
    found = images(stock, {})().numpy()
    assert expected.std() > 0.01
    # Outside, the steps count from the cube instead of the camera.
    atol = 1e-4 if eye[0] < 1 else 1e-3
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=atol)


@IN_RGB_FIRST
@pytest.mark.parametrize(
    ("seeing", "eye"),
    [("path", (3, 2, 1)), ("direct", (0.7, 0.5, 0)), ("prb", (3, 2, 1))],
    ids=["path outside", "direct inside", "prb outside"],
)
def test_field_emitter(grid: str, rng, seeing: str, eye) -> None:
    fields = emitter(object=volume(grid))
    found = problem(scene({"type": seeing}, eye, (0, 0, -0.4), **fields), "colour", 4)
    rough = rng.normal(0, 1, found.base.shape)
    gradient = found.gradient() @ rough.ravel()
    assert gradient == pytest.approx(found.difference(rough, 0.05), rel=1e-3)
    if seeing == "prb" and mi.is_spectral:
        return  # Mitsuba 3.9's prb has no forward mode in spectral variants
    assert found.tangent(rough) == pytest.approx(gradient, rel=1e-3)


DIRECT = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0}  # compiles fast


@IN_RGB
@pytest.mark.parametrize("composite", ["interleaved", "depth"])
def test_field_emitter_of_two_fields(grid: str, rng, composite: str) -> None:
    beside = mi.ScalarTransform4f().translate([0, 0.3, 0]).scale(0.6)
    both = {"one": volume(grid), "two": volume(grid, to_world=beside)}
    lamp = emitter(**both, composite=composite)
    found = problem(scene(DIRECT, (3, 2, 1), **lamp), "two.density")
    found.check([rng.normal(0, 1, found.base.shape)])


@pytest.mark.parametrize("name", ["table", "sky"])
def test_field_emitter_of_an_ngp(ngp: str, rng, name: str) -> None:
    lamp = emitter(object=volume(ngp, "ngp_field"))
    check_network(problem(scene(DIRECT, (3, 2, 1), **lamp), name), rng, name)


# Hard points


@IN_RGB
def test_opacity_one(tmp_path: Path, rng) -> None:
    name = write(tmp_path / "box.safetensors", small.homogeneous(1e4))
    loaded = scene(integrator(object=volume(name), aovs=True))
    assert np.array(mi.render(loaded, spp=1))[..., -2].max() > 1 - 1e-6
    found = problem(loaded, "colour")
    found.check(directions(rng, field_of(loaded), found.base.shape))
    opaque = problem(loaded, "density")
    # Nothing passes: more density changes no colour, as all have the same.
    assert np.abs(opaque.gradient()).max() < 1e-3 * np.abs(found.gradient()).max()


@IN_RGB
def test_opacity_zero(tmp_path: Path, rng) -> None:
    field = small.blob(rng, step_m=0.1)
    field.set_parameter("density", np.full(field.n_vertices, -60, np.float32))
    name = write(tmp_path / "clear.safetensors", field)
    loaded = scene(integrator(object=volume(name), aovs=True))
    assert not np.array(mi.render(loaded, spp=1))[..., [0, -2]].any()
    for parameter in ("colour", "density"):
        found = problem(loaded, parameter)
        found.check_zero(rng.normal(0, 1, found.base.shape))


@IN_RGB
@pytest.mark.parametrize(
    ("eye", "target"),
    [((3, 1, 0.5), (3, 1, 9)), ((3, 0, 0), (9, 0, 0.1))],
    ids=["empty ray", "behind the camera"],
)
def test_objects_out_of_view(grid: str, rng, eye, target) -> None:
    loaded = scene(integrator(object=volume(grid)), eye, target)
    for parameter in ("colour", "density"):
        found = problem(loaded, parameter)
        found.check_zero(rng.normal(0, 1, found.base.shape))


@IN_RGB
@pytest.mark.parametrize("density", [-200.0, 9.0], ids=["opacity 0", "opacity 1"])
def test_emitter_at_the_ends_of_opacity(tmp_path: Path, rng, density: float) -> None:
    field = small.blob(rng, step_m=0.1)
    raw = np.full(field.n_vertices, density / field.layout.levels)
    field.set_parameter("density", raw.astype(np.float32))
    name = write(tmp_path / "box.safetensors", field)
    found = problem(scene(DIRECT, (3, 2, 1), **emitter(object=volume(name))), "colour")
    direction = rng.normal(0, 1, found.base.shape)
    if density > 0:
        found.check([direction])
    else:
        found.check_zero(direction)


@IN_RGB
@pytest.mark.parametrize("method", ["eval", "eval_1", "eval_3"])
def test_volume_outside_of_its_box(grid: str, rng, method: str) -> None:
    loaded = mi.load_dict(volume(grid, quantity="radiance"))
    it = interactions(rng)
    it.p += mi.Vector3f(2, 0, 0)
    output = evaluated(loaded, method, it)
    found = Derivatives(mi.traverse(loaded), "colour", output)
    found.check_zero(rng.normal(0, 1, found.base.shape))


@IN_RGB
@pytest.mark.parametrize(
    "composite", [pytest.param("interleaved", marks=pytest.mark.slow), "depth"]
)
def test_touching_objects(grid: str, rng, composite: str) -> None:
    beside = mi.ScalarTransform4f().translate([0, 2, 0])
    one, two = volume(grid), volume(grid, to_world=beside)
    view = (2.5, 3.5, 0.6), (0, 0.9, 0)
    seeing = integrator(one=one, two=two, composite=composite)
    image = np.array(mi.render(scene({**seeing, "aovs": True}, *view), spp=4))
    assert ((image[..., -1] < np.inf) & (image[..., -6] < np.inf)).any()
    loaded = scene(seeing, *view)
    for name in ("one.colour", "two.density"):
        found = problem(loaded, name)
        found.check(directions(rng, field_of(loaded), found.base.shape))


@IN_RGB
def test_camera_inside(grid: str, rng) -> None:
    loaded = scene(integrator(object=volume(grid)), (0.2, 0.1, 0))
    found = problem(loaded, "density")
    found.check(directions(rng, field_of(loaded), found.base.shape))
