"""Fields inside the stock heterogeneous medium, against the stock gridvolume.

A field of one level and two vertices an edge is `exp` of one trilinear function. A
gridvolume of 80 vertices an edge, whose texel centres reach from corner to corner of
the field's box, interpolates it with a relative error below 1e-6:
small enough that no random decision of a path falls the other way.
"""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import RGB, SPECTRAL, later
from support.worlds import fields as small

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout, load_field, save_field
from mi_nerfattack.scenes import bundled

TEXELS = 80
CENTRES = np.linspace(-1, 1, TEXELS)
ALBEDO = {"type": "constvolume", "value": {"type": "rgb", "value": [0.8, 0.5, 0.3]}}


@pytest.fixture
def path(tmp_path: Path, each_variant: str, rng: np.random.Generator) -> Path:
    """A file with a smooth field in [-1, 1]^3."""
    field = GridField(GridLayout(1, 2, 2), -small.ONES, small.ONES)
    raw = rng.uniform(-0.06, 0.06, 8).astype(np.float32)
    field.set_parameter("density", raw)
    field.set_parameter("texture", rng.normal(0, 0.3, (8, 3)).astype(np.float32))
    save_field(tmp_path / "field.safetensors", field)
    return tmp_path / "field.safetensors"


def own(path: Path, quantity: str = "density") -> dict[str, Any]:
    """Describe the field as a volume."""
    return {"type": "grid_field", "filename": str(path), "quantity": quantity}


def stock(values: np.ndarray) -> dict[str, Any]:
    """Describe a gridvolume with texel centres at CENTRES."""
    half = 1 / (TEXELS - 1)
    place = mi.ScalarTransform4f().translate(-1 - half).scale(2 * (1 + half))
    grid = mi.VolumeGrid(values.reshape(*[TEXELS] * 3, -1).astype(np.float32))
    options = {"raw": True, "accel": False}  # a GPU's texture unit is less precise
    return {"type": "gridvolume", "grid": grid, "to_world": place, **options}


def vertices() -> np.ndarray:
    """Return the places of the gridvolume's texel centres, (TEXELS^3, 3)."""
    z, y, x = np.meshgrid(CENTRES, CENTRES, CENTRES, indexing="ij")
    return np.stack([x, y, z], -1).reshape(-1, 3)


def sampled(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Sample density and radiance of the field, in float64, as gridvolumes."""
    density, radiance = small.eval_grid(load_field(path), vertices())
    return stock(density), stock(radiance)


def scene(sigma_t: Any, albedo: Any, integrator: str) -> mi.Scene:
    """Load a cube of a medium in a constant light."""
    light = {"type": "rgb", "value": [1.0, 0.7, 0.4]}
    medium = {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": albedo}
    world = {
        "light": {"type": "constant", "radiance": light},
        "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
    }
    seeing = {"type": integrator, "max_depth": 5}
    return small.load(seeing, world, eye=(3, 2, 1), fov=40)


@pytest.mark.parametrize("integrator", ["volpath", *later("volpathmis", "prbvolpath")])
def test_fields_render_as_gridvolumes(path: Path, integrator: str) -> None:
    density, radiance = sampled(path)
    pairs = [(own(path), own(path, "radiance")), (density, radiance)]
    if mi.is_spectral:  # stock albedos are other spectra of the same colour
        pairs = [(own(path), ALBEDO), (density, ALBEDO)]
    a, b = [np.array(mi.render(scene(*p, integrator), spp=8, seed=1)) for p in pairs]
    assert b.std() > 0.05
    np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("each_variant", RGB, indirect=True)
def test_a_changed_density_reaches_the_medium(path: Path) -> None:
    # Twice the density also needs twice the majorant, which the medium keeps.
    _, radiance = sampled(path)
    density, _ = small.eval_grid(load_field(path), vertices())
    loaded = scene(own(path), ALBEDO, "volpath")
    params = mi.traverse(loaded)
    key = "cube.interior_medium.sigma_t.density"
    params[key] = params[key] + float(np.log(2))
    params.update()
    doubled = scene(stock(2 * density), ALBEDO, "volpath")
    a, b = [np.array(mi.render(item, spp=8, seed=1)) for item in (loaded, doubled)]
    np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_limit_cuts_density_and_majorant(path: Path, rng) -> None:
    unlimited = mi.load_dict(own(path))
    cut = mi.load_dict({**own(path), "density_limit": 1.0})
    it = dr.zeros(mi.Interaction3f, 1000)
    it.p = mi.Point3f(rng.uniform(-1, 1, (3, 1000)).astype(np.float32))
    expected = np.minimum(unlimited.eval_1(it).numpy(), 1)
    assert 0.1 < (expected == 1).mean() < 0.9
    np.testing.assert_array_equal(cut.eval_1(it).numpy(), expected)
    assert cut.max() == 1 < unlimited.max()


def gradients(loaded: mi.Scene, suffixes: tuple[str, ...]) -> list[np.ndarray]:
    """Differentiate a fixed random projection of an image."""
    params = mi.traverse(loaded)
    keys = [f"cube.interior_medium.{suffix}" for suffix in suffixes]
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    image = mi.render(loaded, params, spp=16, seed=1, seed_grad=2)
    weight = np.random.default_rng(3).normal(size=image.shape).astype(np.float32)
    dr.backward(dr.sum(image * mi.TensorXf(weight)))
    return [dr.grad(params[key]).numpy().astype(float) for key in keys]


@pytest.mark.parametrize("each_variant", RGB, indirect=True)
@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_a_medium_does_not_move(each_variant: str, shift: float) -> None:
    """A new pose and a derivative by the pose are refused, and not 0."""
    path = bundled("hydrant/field.safetensors")
    loaded = scene(own(path), own(path, "radiance"), "prbvolpath")
    params = mi.traverse(loaded)
    (key,) = (name for name in params.keys() if name.endswith("sigma_t.to_world"))
    x = mi.Float(shift)
    dr.enable_grad(x)
    params[key] = mi.AffineTransform4f().translate([x, 0, 0]) @ params[key]
    params.update()
    why = None
    try:
        dr.backward(dr.mean(mi.render(loaded, params, spp=1)))
    except RuntimeError as err:
        why = err
        while why.__cause__ is not None:  # Mitsuba and Dr.Jit wrap it
            why = why.__cause__
        why = type(why), str(why)
    # Mitsuba traces the volumes of all scenes that are alive
    del loaded, params
    gc.collect()
    assert why is not None and why[0] is InputError
    assert ("cannot follow to_world" if shift else "no derivative") in why[1]


@pytest.mark.parametrize("each_variant", [*RGB, *later(*SPECTRAL)], indirect=True)
def test_gradients_are_those_of_gridvolume_by_the_chain_rule(path: Path) -> None:
    density, radiance = sampled(path)
    albedos = [ALBEDO] * 2 if mi.is_spectral else [own(path, "radiance"), radiance]
    by_texture = not mi.is_spectral
    loaded = scene(own(path), albedos[0], "prbvolpath")
    names = ("sigma_t.density", "albedo.colour")[: 1 + by_texture]
    actual = gradients(loaded, names)
    loaded = scene(density, albedos[1], "prbvolpath")
    names = ("sigma_t.data", "albedo.data")[: 1 + by_texture]
    values = gradients(loaded, names)

    unit = (vertices() + 1) / 2
    corner = np.array([[(v >> axis) & 1 for axis in range(3)] for v in range(8)])
    weight = np.where(corner[:, None], unit, 1 - unit).prod(-1)  # (8, texels)
    field = load_field(path)
    expected = weight @ (values[0].ravel() * small.eval_grid(field, vertices())[0])
    scale = np.abs(expected).max()
    np.testing.assert_allclose(actual[0], expected, atol=1e-3 * scale)
    if by_texture:
        raw = field.texture.numpy().astype(float)
        h = 1e-5
        step = weight.T @ raw
        slope = small.sigmoid_to_linear(step + h) - small.sigmoid_to_linear(step - h)
        expected = weight @ (values[1].reshape(-1, 3) * slope / (2 * h))
        colour = 1 / (1 + np.exp(-raw))
        expected /= colour * (1 - colour)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(actual[1], expected, atol=1e-3 * scale)
