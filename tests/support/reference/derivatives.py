"""Derivatives checked by differences, launches counted, variants, states in float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

Output = Callable[[], Any]


def total(array: Any, weight: np.ndarray) -> float:
    """Return the inner product of an array with weights, summed in float64."""
    return float((array.numpy().astype(float).ravel() * weight).sum())


def central_difference(f: Callable[[float], float], step: float) -> float:
    """Differentiate at 0 with an error of fourth order (Richardson)."""
    coarse = (f(step) - f(-step)) / (2 * step)
    fine = (f(step / 2) - f(-step / 2)) / step
    return (4 * fine - coarse) / 3


class Derivatives:
    """Three ways to differentiate a random projection of an output by a parameter.

    The output has no random numbers but fixed ones. Weights of the projection lie in
    [0.1, 1]. Steps of colours are in units of c (1 - c), which keep them in [0, 1].
    """

    def __init__(self, params: Any, key: str, output: Output, seed: int = 0) -> None:
        self.params, self.key, self.output = params, key, output
        self.base = params[key].numpy().copy()
        self.unit = self.base * (1 - self.base) if key.endswith("colour") else 1
        size = output().numpy().size
        rng = np.random.default_rng(seed)
        self.weight = rng.uniform(0.1, 1, size).astype(np.float32)

    def _set(self, values: np.ndarray) -> Any:
        kind = type(self.params[self.key])
        self.params[self.key] = kind(values.astype(self.base.dtype))
        return self.params[self.key]

    def _reset(self) -> None:
        self._set(self.base)
        self.params.update()

    def value(self, direction: np.ndarray, s: float) -> float:
        """Return the projection after a step along a direction."""
        self._set(self.base + s * self.unit * direction.reshape(self.base.shape))
        self.params.update()
        return total(self.output(), self.weight)

    def difference(self, direction: np.ndarray, step: float) -> float:
        result = central_difference(lambda s: self.value(direction, s), step)
        self._reset()
        return result

    def gradient(self) -> np.ndarray:
        dr.enable_grad(self._set(self.base))
        self.params.update()
        output = self.output()
        weight = type(output)(self.weight.reshape(output.numpy().shape))
        dr.backward(dr.sum(output * weight, axis=None))
        result = dr.grad(self.params[self.key]).numpy().astype(float) * self.unit
        self._reset()
        return result.ravel()

    def tangent(self, direction: np.ndarray) -> float:
        attached = self._set(self.base)
        dr.enable_grad(attached)
        self.params.update()
        shaped = self.unit * direction.reshape(self.base.shape)
        shaped = shaped.astype(self.base.dtype)
        dr.set_grad(self.params[self.key], type(attached)(shaped))
        dr.forward_from(self.params[self.key], dr.ADFlag.ClearEdges)
        output = self.output()
        dr.forward_to(output)
        result = total(dr.grad(output), self.weight)
        self._reset()
        return result

    def check(
        self, directions: list[np.ndarray], step: float = 0.05, rtol: float = 1e-3
    ) -> None:
        """Compare the three along directions; fail unless they agree."""
        gradient = self.gradient()
        assert np.isfinite(gradient).all()
        for direction in directions:
            backward = float(gradient @ direction.ravel())
            # The dot-product identity: both sides are <W, J v>.
            np.testing.assert_allclose(self.tangent(direction), backward, rtol=rtol)
            expected = self.difference(direction, step)
            np.testing.assert_allclose(backward, expected, rtol=rtol)

    def check_zero(self, direction: np.ndarray) -> None:
        assert not self.gradient().any()
        assert self.tangent(direction) == 0
        assert self.difference(direction, 0.1) == 0


def key_of(params: Any, end: str) -> str:
    """Return the key of the one parameter of a scene that ends so."""
    names = params.keys()  # iterating `params` itself gives pairs
    (key,) = (name for name in names if name.endswith(end))
    return key


def images(
    scene: mi.Scene, params: Any, spp: int = 2, seed: int = 3
) -> Callable[[], mi.TensorXf]:
    """Return a function that renders the colour channels of a scene.

    Primal and derivative pass draw the same samples: a central difference needs that.
    """
    count = 1 if mi.is_monochromatic else 3

    def output() -> mi.TensorXf:
        if any(dr.grad_enabled(params[key]) for key in params.keys()):
            image = mi.render(scene, params, spp=spp, seed=seed + 4, seed_grad=seed)
        else:
            image = mi.render(scene, spp=spp, seed=seed)
        return image[..., :count]

    return output


@contextmanager
def nothing_compiled() -> Iterator[None]:
    """Fail unless kernels are launched within, all of which are known."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield
        history = dr.kernel_history((dr.KernelType.JIT,))
    assert history and all(kernel["cache_hit"] for kernel in history)


_BACKENDS = ["llvm", "cuda"] if dr.has_backend(dr.JitBackend.CUDA) else ["llvm"]
_NAMES = [f"{backend}_ad_" for backend in _BACKENDS]

MONO = [name + "mono" for name in _NAMES if name + "mono" in mi.variants()]
RGB = [name + "rgb" for name in _NAMES if name + "rgb" in mi.variants()]
SPECTRAL = [name + "spectral" for name in _NAMES if name + "spectral" in mi.variants()]


def later(*values: object) -> list[object]:
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


#: What mono does of its own, tests of colour say; `make test-all` runs all of it.
VARIANTS = [*RGB, *SPECTRAL, *later(*MONO)]


def row64(values):
    """Upload (n,); a list, as the alignment of NumPy's memory is part of a kernel."""
    return dr.llvm.ad.Float64(np.asarray(values, float).tolist())


def state64(values):
    rows = [row64(row) for row in values]
    return (dr.llvm.ad.Array3f64 if len(rows) == 3 else dr.llvm.ad.ArrayXf64)(*rows)


def digits(value):
    """Return a document whose numbers are rounded to 14 digits.

    Ends of a BCa interval depend in their last bit on the version of scipy.
    """
    if isinstance(value, dict):
        return {key: digits(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [digits(item) for item in value]
    return float(f"{value:.14g}") if isinstance(value, float) else value
