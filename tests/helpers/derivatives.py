"""Check derivatives of anything that depends on parameters of a Mitsuba object."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

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
    """Three ways to differentiate a random projection of an output.

    Steps of colours are in units of c (1 - c), which keep them between 0 and 1.

    Args:
        params: of the object, from `mi.traverse`.
        key: the parameter.
        output: computes the output from the object as it is; no random numbers but
            fixed ones.
        seed: of the projection, whose weights lie in [0.1, 1].
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
        """Return the directional derivative by central differences."""
        result = central_difference(lambda s: self.value(direction, s), step)
        self._reset()
        return result

    def gradient(self) -> np.ndarray:
        """Return the gradient, flat, in backward mode."""
        dr.enable_grad(self._set(self.base))
        self.params.update()
        found = self.output()
        weight = type(found)(self.weight.reshape(found.numpy().shape))
        dr.backward(dr.sum(found * weight, axis=None))
        result = dr.grad(self.params[self.key]).numpy().astype(float) * self.unit
        self._reset()
        return result.ravel()

    def tangent(self, direction: np.ndarray) -> float:
        """Return the directional derivative in forward mode."""
        attached = self._set(self.base)
        dr.enable_grad(attached)
        self.params.update()
        shaped = self.unit * direction.reshape(self.base.shape)
        shaped = shaped.astype(self.base.dtype)
        dr.set_grad(self.params[self.key], type(attached)(shaped))
        dr.forward_from(self.params[self.key], dr.ADFlag.ClearEdges)
        found = self.output()
        dr.forward_to(found)
        result = total(dr.grad(found), self.weight)
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
        """Fail unless the derivatives are exactly zero."""
        assert not self.gradient().any()
        assert self.tangent(direction) == 0
        assert self.difference(direction, 0.1) == 0


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
