"""Linear RGB as spectra: the basis, the round trip through film, derivatives."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import MONO, RGB
from support.worlds import fields as small

from mi_nerfattack.fields import save_field
from mi_nerfattack.render.lighting import spectrum

COLOURS = [*np.eye(3), np.ones(3), np.array([0.2, 0.5, 0.9]), np.array([7.0, 0.1, 0])]
TO_RGB = np.array(
    [
        [3.240479, -1.537150, -0.498535],
        [-0.969256, 1.875991, 0.041556],
        [0.055648, -0.204043, 1.057311],
    ]
)
WAVELENGTHS = np.linspace(360, 830, 4701)


def colour(values: np.ndarray) -> mi.Color3f:
    """Make an opaque colour."""
    result = mi.Color3f(*map(float, values))
    dr.make_opaque(result)
    return result


def observed_rgb(values: np.ndarray) -> np.ndarray:
    """Integrate an emission against the observer in float64: linear RGB."""
    nm = mi.Float(WAVELENGTHS.astype(np.float32))
    emitted = np.array(spectrum.emission(colour(values), mi.Spectrum(nm)))[0]
    matching = np.array(mi.cie1931_xyz(nm))
    xyz = np.trapezoid(matching.astype(float) * emitted, WAVELENGTHS)
    return TO_RGB @ xyz * mi.MI_CIE_Y_NORMALIZATION


@pytest.mark.usefixtures("spectral")
def test_basis_is_a_partition_into_reflectances() -> None:
    basis = spectrum.basis()
    assert basis.shape == (3, 95)
    assert basis.min() >= 0 and basis.max() <= 1
    np.testing.assert_allclose(basis.sum(0), 1, atol=1e-7)


@pytest.mark.usefixtures("spectral")
@pytest.mark.parametrize("values", COLOURS, ids=str)
def test_every_colour_comes_back_from_its_spectrum(values: np.ndarray) -> None:
    spectrum.prepare()
    np.testing.assert_allclose(observed_rgb(values), values, atol=1e-3 * values.max())


@pytest.mark.usefixtures("spectral")
def test_an_opaque_field_shows_its_colour_on_film(tmp_path: Path) -> None:
    field = small.homogeneous(1e4)
    raw = np.array([0.9, -0.2, -1.0])
    texture = np.tile(raw / 2, (field.n_vertices, 1))
    field.set_parameter("texture", texture.astype(np.float32))
    save_field(tmp_path / "box.safetensors", field)
    path = str(tmp_path / "box.safetensors")
    view = {"eye": (3, 0, 0), "fov": 20, "width": 16, "height": 16}
    scene = small.load({"a": {"type": "grid_field", "filename": path}}, **view)
    image = np.array(mi.render(scene, spp=8192))
    radiance = image[..., :3].mean((0, 1))
    np.testing.assert_allclose(radiance, small.sigmoid_to_linear(raw), atol=1e-3)


@pytest.mark.usefixtures("spectral")
def test_white_is_the_stock_illuminant() -> None:
    spectrum.prepare()
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = mi.Spectrum(365.0, 480.0, 612.3, 829.0)
    stock = mi.load_dict({"type": "d65"}).eval(si)
    rgb = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    own = spectrum.emission(mi.Color3f(1), si.wavelengths)
    np.testing.assert_allclose(own, stock, rtol=1e-5)
    np.testing.assert_allclose(own, mi.load_dict(rgb).eval(si), rtol=2e-3)
    white = spectrum.reflectance(mi.Color3f(1), si.wavelengths)
    np.testing.assert_allclose(white, 1, atol=1e-6)


@pytest.mark.usefixtures("spectral")
def test_invisible_wavelengths_are_dark() -> None:
    spectrum.prepare()
    edges = mi.Spectrum(359.0, 360.0, 830.0, 831.0)
    lit = np.array(spectrum.emission(mi.Color3f(1), edges)).ravel() > 0
    assert lit.tolist() == [False, True, True, False]


@pytest.mark.usefixtures("spectral")
@pytest.mark.parametrize("convert", [spectrum.emission, spectrum.reflectance])
def test_conversion_is_linear_and_so_is_its_derivative(convert, rng) -> None:
    spectrum.prepare()
    wavelengths = mi.Spectrum(*map(float, rng.uniform(380, 780, 4)))
    a, b = rng.uniform(0, 2, (2, 3))
    both = np.array(convert(colour(a + 3 * b), wavelengths))
    apart = np.array(
        convert(colour(a), wavelengths) + 3 * convert(colour(b), wavelengths)
    )
    np.testing.assert_allclose(both, apart, rtol=1e-5)

    x = colour(a)
    dr.enable_grad(x)
    dr.set_grad(x, colour(b))
    tangent = dr.forward_to(convert(x, wavelengths))
    np.testing.assert_allclose(tangent, convert(colour(b), wavelengths), rtol=1e-5)


@pytest.mark.parametrize("each_variant", RGB + MONO, indirect=True)
def test_mono_is_luminance_and_rgb_stays(each_variant: str) -> None:
    spectrum.prepare()
    values = np.array([0.2, 0.5, 0.9])
    expected = (
        values @ [0.212671, 0.715160, 0.072169] if mi.is_monochromatic else values
    )
    for convert in (spectrum.emission, spectrum.reflectance):
        actual = np.array(convert(colour(values), mi.Color0f())).ravel()
        rtol = 1e-5 if mi.is_monochromatic else 1e-6
        np.testing.assert_allclose(actual, expected, rtol=rtol)
