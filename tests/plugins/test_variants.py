"""Every plugin in every variant: primal, forward and backward mode.

Derivatives are compared with Richardson-extrapolated central differences along random
directions, and with each other (dot-product identity).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import (
    MONO,
    RGB,
    SPECTRAL,
    Derivatives,
    images,
    key_of,
    later,
)
from support.worlds import fields as small
from support.worlds.fields import T, load

from mi_nerfattack.fields import AbstractField, save_field
from mi_nerfattack.render.lighting.spectrum import emission

pytestmark = pytest.mark.usefixtures("each_variant")

#: For what does not meet the conversion of colours.
IN_RGB = pytest.mark.parametrize("each_variant", RGB, indirect=True)
IN_RGB_FIRST = pytest.mark.parametrize(
    "each_variant", [*RGB, *later(*SPECTRAL, *MONO)], indirect=True
)
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
NETWORKS = ("table", "density_weights", "colour_weights")
SIDE, BELOW = (3.0, 1.0, 0.5), (0, 0, -0.4)


@pytest.fixture(autouse=True)
def silent(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """Let what Dr.Jit logs fail the test."""
    yield
    assert capfd.readouterr().err == ""


def write(path: Path, field: AbstractField, kind: str = "grid_field") -> dict[str, Any]:
    """Save a field and describe it as a volume."""
    save_field(path, field)
    return {"type": kind, "filename": str(path)}


@pytest.fixture
def volumes(tmp_path: Path, each_variant: str, rng: np.random.Generator) -> dict:
    """Volumes by name: a blob in [-1, 1]^3, here and there, and an NGP with a sky."""
    blob = small.blob(rng, step_m=0.1)
    grid = write(tmp_path / "grid.safetensors", blob)
    blob.set_parameter("density", np.full(blob.n_vertices, -66, np.float32))
    opaque = small.homogeneous(1e4)
    return {
        "grid": grid,
        "overlapping": {**grid, "to_world": T().translate([0, 0.3, 0]).scale(0.6)},
        "clear": write(tmp_path / "clear.safetensors", blob),
        "opaque": write(tmp_path / "opaque.safetensors", opaque),
        "ngp": write(tmp_path / "ngp.safetensors", smooth_ngp(), "ngp_field"),
    }


def smooth_ngp() -> AbstractField:
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


def integrator(volumes: dict[str, Any], **nested: Any) -> dict[str, Any]:
    """Describe an integrator; names of volumes become volumes."""
    named = {
        k: volumes.get(v, v) if isinstance(v, str) else v for k, v in nested.items()
    }
    return {"jitter": True, **named}


def emitter(volumes: dict[str, Any], **nested: Any) -> dict[str, Any]:
    """Describe a cube with a field_emitter above a white floor."""
    lamp = integrator(volumes, **nested) | {"type": "field_emitter", "stop": 0.0}
    del lamp["jitter"]
    cube = {"type": "cube", "to_world": T().scale(1.01), "bsdf": BLACK, "e": lamp}
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -1.2]).scale(4)}
    return {"cube": cube, "floor": floor}


def problem(loaded: mi.Scene, name: str, spp: int = 2) -> Derivatives:
    """Differentiate the image of a scene by the parameter with a name."""
    params = mi.traverse(loaded)
    return Derivatives(params, key_of(params, name), images(loaded, params, spp))


def check(derivatives: Derivatives, rng: np.random.Generator) -> None:
    """Compare derivatives along a random direction.

    On CUDA networks compute in half precision, so their comparison is loose there.
    """
    options = ()
    if derivatives.key.rpartition(".")[2] in NETWORKS:
        options = (2e-2, 0.1) if mi.variant().startswith("cuda") else (2e-2,)
    derivatives.check([rng.normal(0, 1, derivatives.base.shape)], *options)


# Volumes


def interactions(rng: np.random.Generator) -> mi.Interaction3f:
    """Make 40 points in the box, at wavelengths that differ."""
    it = dr.zeros(mi.Interaction3f, 40)
    it.p = mi.Point3f(rng.uniform(-0.9, 0.9, (3, 40)).astype(np.float32))
    if mi.is_spectral:
        nm = rng.uniform(400, 700, (4, 40)).astype(np.float32)
        it.wavelengths = mi.Spectrum(nm)
    return it


def evaluated(loaded: mi.Volume, name: str, method: str, it: Any) -> Derivatives:
    """Differentiate what a method of a volume returns."""
    params = mi.traverse(loaded)
    return Derivatives(params, name, lambda: dr.ravel(getattr(loaded, method)(it)))


@pytest.mark.parametrize(
    ("kind", "name", "method"),
    [("grid", "colour", method) for method in ("eval", "eval_1", "eval_3")]
    + [("grid", "density", method) for method in ("eval", "eval_1")]
    + [("ngp", name, "eval") for name in NETWORKS],
)
def test_volumes(volumes, rng, kind: str, name: str, method: str) -> None:
    quantity = "density" if name == "density" else "radiance"
    loaded = mi.load_dict({**volumes[kind], "quantity": quantity})
    check(evaluated(loaded, name, method, interactions(rng)), rng)


@pytest.mark.parametrize("each_variant", RGB + SPECTRAL + MONO, indirect=True)
def test_spectra_of_volumes_are_those_of_their_colours(volumes, rng) -> None:
    loaded = mi.load_dict({**volumes["grid"], "quantity": "radiance"})
    it = interactions(rng)
    colour = loaded.eval_3(it)
    spectrum = np.array(loaded.eval(it))
    if mi.is_monochromatic:
        expected = np.array(mi.luminance(mi.Color3f(colour)))[None]
    elif mi.is_spectral:
        lit = np.array(emission(mi.Color3f(colour), it.wavelengths))
        d65 = np.array([mi.cie_d65(nm) for nm in it.wavelengths])
        expected = lit / d65
    else:
        expected = np.array(colour)
    np.testing.assert_allclose(spectrum, expected, rtol=1e-4)
    if mi.is_rgb:
        luminance = np.array(mi.luminance(mi.Color3f(colour)))
        np.testing.assert_allclose(loaded.eval_1(it).numpy(), luminance, atol=1e-4)
        assert loaded.max() == 1


# The integrator


@pytest.mark.parametrize(
    ("name", "nested", "eye"),
    [
        ("a.colour", {"a": "grid"}, SIDE),
        ("a.density", {"a": "grid", "composite": "depth"}, (0.2, 0.1, 0)),
        ("a.density", {"a": "grid", "behind": {"type": "prb"}}, SIDE),
        *[(f"a.{name}", {"a": "ngp"}, SIDE) for name in (*NETWORKS, "sky")],
    ],
)
def test_field_integrator(volumes, rng, name: str, nested: dict, eye) -> None:
    light = {"light": {"type": "constant"}} if "behind" in nested else {}
    loaded = load(integrator(volumes, **nested), light, eye=eye)
    check(problem(loaded, name, 16 if light else 2), rng)


# The emitter


@pytest.mark.parametrize("eye", [(3, 2, 1), (0.4, 0.2, 0)], ids=["outside", "inside"])
def test_path_shows_what_the_integrator_shows(tmp_path, rng, eye) -> None:
    fields = {
        "grid": write(tmp_path / "fine.safetensors", small.blob(rng, step_m=0.03)),
        "ngp": write(tmp_path / "ngp.safetensors", small.small_ngp(), "ngp_field"),
    }
    fields["ngp"]["step_m"] = 0.02
    loaded = load(fields, eye=eye)
    expected = images(loaded, {}, 1)().numpy()
    cube = emitter(fields, one="grid", two="ngp")["cube"]
    image = images(load({"type": "path"}, {"cube": cube}, eye=eye), {}, 1)().numpy()
    assert expected.std() > 0.01
    # Rays that pass by the cube see the sky of the integrator alone.
    met = image.sum(-1) > 0
    # Outside, the steps count from the cube instead of the camera.
    atol = 1e-4 if eye[0] < 1 else 3e-3
    np.testing.assert_allclose(image[met], expected[met], rtol=1e-3, atol=atol)


@IN_RGB_FIRST
@pytest.mark.parametrize(
    ("seeing", "eye"),
    [("path", (3, 2, 1)), ("direct", (0.7, 0.5, 0)), ("prb", (3, 2, 1))],
    ids=["path outside", "direct inside", "prb outside"],
)
def test_field_emitter(volumes, rng, seeing: str, eye) -> None:
    world = emitter(volumes, a="grid")
    derivatives = problem(
        load({"type": seeing}, world, eye=eye, target=BELOW), "colour", 4
    )
    rough = rng.normal(0, 1, derivatives.base.shape)
    gradient = derivatives.gradient() @ rough.ravel()
    assert gradient == pytest.approx(derivatives.difference(rough, 0.05), rel=1e-3)
    if seeing == "prb" and mi.is_spectral:
        return  # Mitsuba 3.9's prb has no forward mode in spectral variants
    assert derivatives.tangent(rough) == pytest.approx(gradient, rel=1e-3)


DIRECT = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0}  # compiles fast


@pytest.mark.parametrize("name", ["table", "sky"])
def test_field_emitter_of_an_ngp(volumes, rng, name: str) -> None:
    check(problem(load(DIRECT, emitter(volumes, a="ngp"), eye=(3, 2, 1)), name), rng)


@IN_RGB
def test_field_emitter_of_two_fields_by_depth(volumes, rng) -> None:
    lamp = emitter(volumes, one="grid", two="overlapping", composite="depth")
    check(problem(load(DIRECT, lamp, eye=(3, 2, 1)), "two.density"), rng)


# Opacity 1, opacity 0, and what is out of view


@IN_RGB
def test_opacity_one(volumes, rng) -> None:
    loaded = load(integrator(volumes, a="opaque", aovs=True), eye=SIDE)
    assert np.array(mi.render(loaded, spp=1))[..., -2].max() > 1 - 1e-6
    by_colour, by_density = problem(loaded, "colour"), problem(loaded, "density")
    check(by_colour, rng)
    # Nothing passes: more density changes no colour, as all have the same.
    most = np.abs(by_colour.gradient()).max()
    assert np.abs(by_density.gradient()).max() < 1e-3 * most
    lamp = load(DIRECT, emitter(volumes, a="opaque"), eye=(3, 2, 1))
    check(problem(lamp, "colour"), rng)


@IN_RGB
@pytest.mark.parametrize(
    ("name", "is_lamp", "eye", "target"),
    [
        ("clear", False, SIDE, (0, 0, 0)),
        ("clear", True, SIDE, (0, 0, 0)),
        ("grid", False, (3, 1, 0.5), (3, 1, 9)),
        ("grid", False, (3, 0, 0), (9, 0, 0.1)),
    ],
    ids=["opacity 0", "emitter", "empty ray", "behind the camera"],
)
def test_nothing_in_view(volumes, rng, name: str, is_lamp: bool, eye, target) -> None:
    seeing, world = integrator(volumes, a=name), {}
    if is_lamp:
        seeing, world = DIRECT, emitter(volumes, a=name)
    loaded = load(seeing, world, eye=eye, target=target)
    for key in ("colour", "density"):
        derivatives = problem(loaded, key)
        assert not derivatives.output().numpy().any()
        derivatives.check_zero(rng.normal(0, 1, derivatives.base.shape))
