"""The vector-Jacobian product of a function of arrays."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.backend.differentiate import vjp

pytestmark = pytest.mark.usefixtures("variant")


def function(x):
    a, (b,) = x
    # a row without a derivative, one variable twice, and the input itself
    return mi.Vector3f(a * b, mi.Float(1, 2, 3), a * b), [dr.sum(b * b), a]


def test_it_is_the_transpose_of_the_derivative(rng):
    a, b, *rows, last = rng.normal(size=(6, 3)).astype(np.float32)
    x = mi.Float(a), [mi.Float(b)]
    dy = mi.Vector3f(*rows), [mi.Float(0.5), mi.Float(last)]
    by_a, (by_b,) = vjp(function, x, dy)
    weight = rows[0] + rows[2]
    np.testing.assert_allclose(by_a, weight * b + last, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(by_b, weight * a + b, rtol=1e-5, atol=1e-6)
    assert not dr.grad_enabled(x) and not dr.grad_enabled(by_a, by_b)


def test_what_the_caller_does_with_gradients_does_not_matter():
    x = mi.Float(1, 2)
    dr.enable_grad(x)
    with dr.suspend_grad():
        found = vjp(lambda x: x * x, x, 3.0)
    np.testing.assert_array_equal(found, [6, 12])
    np.testing.assert_array_equal(dr.grad(x), 0)


def test_a_function_that_does_not_depend_on_its_argument_is_refused():
    with pytest.raises(ValueError):
        vjp(lambda x: mi.Float(1, 2), mi.Float(1, 2), 1.0)
