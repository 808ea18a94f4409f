"""Turn linear RGB into the variant's spectrum, linearly.

Fields hold linear Rec. 709 RGB. In spectral variants, a colour ``(r, g, b)`` means
the reflectance ``r s_R + g s_G + b s_B``. As a radiance, it means this reflectance
times Mitsuba's D65. The three basis reflectances lie in [0, 1], add up to 1, and
reproduce the primaries under D65, so white is the illuminant itself. The map is linear:
compositing before and after it gives the same, and its derivative is exact. Stock
``rgb`` spectra are sigmoids of polynomials instead: they agree in every colour that a
film records, but not wavelength by wavelength.

Source: Mallett & Yuksel 2019, Spectral Primary Decomposition for Rendering with sRGB
Reflectance.
"""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

SAMPLES = 95  # of Mitsuba's own tables: every 5 nm from 360 to 830 nm
_EXACTLY = 1e4  # weight of what must hold, relative to the smoothness


@functools.cache
def basis() -> np.ndarray:
    """Solve for the three basis reflectances, (3, SAMPLES), float64 in [0, 1].

    The smoothest bounded functions (least squared differences) that add up to 1 and
    whose colours under D65 are the primaries of Rec. 709, up to the distance of
    Mitsuba's own D65 from white (2e-4). Not inside a recorded loop or call.
    """
    from scipy.optimize import nnls  # slow to import

    observer = _observer()
    each = np.eye(SAMPLES)
    rows = np.vstack(
        [
            np.kron(np.eye(3), np.diff(each, axis=0)),
            _EXACTLY * np.kron(np.ones((1, 3)), each),
            _EXACTLY * np.kron(np.eye(3), observer),
        ]
    )
    primaries = np.diag(observer.sum(1))
    smooth = np.zeros(3 * (SAMPLES - 1))
    exact = np.concatenate([np.ones(SAMPLES), primaries.ravel()])
    goal = np.concatenate([smooth, _EXACTLY * exact])
    # Not negative and with sum 1, so none exceeds 1.
    return np.minimum(nnls(rows, goal)[0], 1).reshape(3, SAMPLES)


def prepare() -> None:
    """Make the tables of the active variant; call it before anything is recorded."""
    if mi.is_spectral:
        _table(mi.variant())


def emission(colour: mi.Color3f, wavelengths: Any) -> Any:
    """Turn the linear RGB of a radiance into the variant's spectrum; differentiable.

    Args:
        colour: (3, n), linear Rec. 709, any non-negative value.
        wavelengths: (4, n), nanometres, of spectral variants; ignored elsewhere.

    Returns:
        radiance at the wavelengths, (4, n), in spectral variants; luminance (1, n)
        in monochromatic ones; the colour itself in RGB ones.
    """
    if not mi.is_spectral:
        return _uncoloured(colour)
    primaries, illuminant = _lookup(wavelengths)
    return _mix(colour, primaries) * illuminant


def reflectance(colour: mi.Color3f, wavelengths: Any) -> Any:
    """Turn the linear RGB of an albedo into the variant's spectrum; differentiable.

    As :func:`emission`, without the illuminant: white is 1 at every wavelength, and
    colours in [0, 1] stay there.
    """
    if not mi.is_spectral:
        return _uncoloured(colour)
    primaries, _ = _lookup(wavelengths)
    return _mix(colour, primaries)


def _uncoloured(colour: mi.Color3f) -> Any:
    if mi.is_monochromatic:
        return mi.Color1f(mi.luminance(colour))
    return mi.Spectrum(colour)


def _mix(colour: mi.Color3f, primaries: list[Any]) -> Any:
    r, g, b = primaries
    return colour.x * r + colour.y * g + colour.z * b


def _lookup(wavelengths: Any) -> tuple[list[Any], Any]:
    """Interpolate the three basis reflectances and D65, each (4, n)."""
    table = _table(mi.variant())
    scale = (SAMPLES - 1) / (mi.MI_CIE_MAX - mi.MI_CIE_MIN)
    columns = [mi.Spectrum(0) for _ in range(4)]
    for i, wavelength in enumerate(wavelengths):
        position = (wavelength - mi.MI_CIE_MIN) * scale
        visible = (position >= 0) & (position <= SAMPLES - 1)
        low = mi.UInt32(dr.clip(position, 0, SAMPLES - 2))
        a = dr.gather(mi.Vector4f, table, low, visible)
        b = dr.gather(mi.Vector4f, table, low + 1, visible)
        values = dr.lerp(a, b, position - mi.Float(low))
        for column, value in zip(columns, values, strict=True):
            column[i] = value
    return columns[:3], columns[3]


@functools.cache
def _table(variant: str) -> mi.Float:
    """Pack basis and illuminant for a variant's kernels, (4 SAMPLES,)."""
    del variant  # the arrays' type follows from it
    illuminant = mi.cie_d65(mi.Float(_nodes())).numpy()
    columns = np.vstack([basis(), illuminant]).astype(np.float32)
    return mi.Float(columns.T.ravel())


def _nodes() -> np.ndarray:
    return np.linspace(mi.MI_CIE_MIN, mi.MI_CIE_MAX, SAMPLES)


def _observer() -> np.ndarray:
    """Integrate a reflectance's samples to linear RGB under D65, (3, SAMPLES).

    Colour matching functions, illuminant and reflectance are linear between the
    samples: three Gauss-Legendre points an interval integrate their product exactly.
    """
    points, weights = np.polynomial.legendre.leggauss(3)
    part, weights = (points + 1) / 2, weights / 2
    nodes = _nodes()
    width = nodes[1] - nodes[0]
    wavelength = mi.Float((nodes[:-1, None] + width * part).ravel())
    rgb = np.array(mi.xyz_to_srgb(mi.cie1931_xyz(wavelength)), np.float64)
    density = rgb * mi.cie_d65(wavelength).numpy() * mi.MI_CIE_Y_NORMALIZATION
    density = density.reshape(3, SAMPLES - 1, 3) * weights * width
    result = np.zeros((3, SAMPLES))
    result[:, :-1] += (density * (1 - part)).sum(-1)
    result[:, 1:] += (density * part).sum(-1)
    return result
