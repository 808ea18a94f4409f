"""Arrays end to end and apart again, their derivatives, and Adam as arrays."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drjit.opt import Adam
from support.reference.derivatives import nothing_compiled

from mi_nerfattack.backend.arrays import (
    adam_tensors,
    aligned,
    allocated_bytes,
    concat,
    load_adam,
    split,
    vjp,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.rays import Gain, Rays

pytestmark = pytest.mark.usefixtures("variant")


def _rays(rng: np.random.Generator, count: int) -> Rays:
    origin = mi.Point3f(*[mi.Float(rng.random(count).tolist()) for _ in range(3)])
    gains = [Gain(mi.Color3f(mi.Float(rng.random(count).tolist())))]
    rays = Rays(origin, mi.Vector3f(origin), gains=gains)
    rays.jitter, rays.t_max = dr.opaque(mi.Float, 0.5), dr.opaque(mi.Float, dr.inf)
    rays.active = dr.opaque(mi.Bool, True)
    dr.eval(rays)
    return rays


def test_dataclasses_are_laid_leaf_by_leaf_and_single_entries_spread(rng):
    counts = [5, 1, 7]
    chunks = [_rays(rng, count) for count in counts]
    chunks[2].jitter = dr.opaque(mi.Float, 0.25)
    rays = concat(chunks, counts)
    expected = np.concatenate([chunk.origin.numpy() for chunk in chunks], axis=1)
    assert (rays.origin.numpy() == expected).all()
    assert rays.gains[0].colour.numpy().shape == (3, 13)
    assert rays.jitter.numpy().tolist() == [0.5] * 6 + [0.25] * 7
    assert np.isinf(rays.t_max.numpy()).sum() == 13
    assert rays.active.numpy().tolist() == [True] * 13


def test_kernels_do_not_depend_on_sizes_and_numbers_of_parts(rng):
    concat([_rays(rng, 5), _rays(rng, 7)], [5, 7])
    split(dr.arange(mi.Float, 8) + 0.5, 4)
    dr.eval(rows := dr.arange(mi.Float, 12) + 0.5)
    for counts in ((6, 6, 6), (4, 9), (3, 3, 3, 3), (8,)):
        chunks = [_rays(rng, count) for count in counts]
        with nothing_compiled():
            concat(chunks, counts)
    with nothing_compiled():
        chunks = split(rows, 3)
    assert [chunk.numpy().tolist() for chunk in chunks[:2]] == [
        [0.5, 1.5, 2.5],
        [3.5, 4.5, 5.5],
    ]


NAMES = ("tensor", "flat", "half")


def start() -> Adam:
    """Return an optimiser of parameters of all kinds that the project has."""
    parameters = {
        "tensor": mi.TensorXf(np.linspace(0, 1, 6, dtype=np.float32).reshape(2, 3)),
        "flat": mi.Float([1, 2, 3, 4]),
        "half": mi.Float16([0.5, 0.25]),
    }
    optimiser = Adam(lr=0.1, params=parameters, mask_updates=True)
    optimiser.set_learning_rate({"flat": 0.3})
    return optimiser


def steps(optimiser: Adam, first: int, last: int) -> None:
    """Descend towards a point that moves from step to step."""
    for step in range(first, last):
        for name in NAMES:
            value = optimiser[name]
            dr.backward(dr.square(value - 0.1 * step).array)
        optimiser.step()


def test_loaded_state_goes_on_as_the_whole_run():
    uninterrupted, half, resumed = start(), start(), start()
    steps(uninterrupted, 0, 5)
    steps(half, 0, 3)
    load_adam(resumed, adam_tensors(half))
    steps(resumed, 3, 5)
    expected = adam_tensors(uninterrupted)
    assert {int(expected[f"time.{name}"][0]) for name in NAMES} == {5}
    for name, value in adam_tensors(resumed).items():
        np.testing.assert_array_equal(value, expected[name], name)
    for name in NAMES:
        assert type(resumed[name]) is type(uninterrupted[name])
        assert resumed.learning_rate(name) == uninterrupted.learning_rate(name)


def test_arrays_are_copies_and_may_be_loaded_for_some_parameters():
    optimiser, other = start(), start()
    steps(other, 0, 2)
    before, loaded = adam_tensors(optimiser), adam_tensors(other)
    expected = {
        name: (loaded if name.endswith("flat") else before)[name].copy()
        for name in before
    }
    load_adam(optimiser, loaded, ["flat"])
    for value in (*before.values(), *loaded.values()):
        value[...] = 7
    for name, value in adam_tensors(optimiser).items():
        np.testing.assert_array_equal(value, expected[name], name)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("value.tensor", (3, 2)),
        ("first.tensor", (6,)),
        ("second.flat", (5,)),
        ("time.flat", (2,)),
    ],
)
def test_other_shapes_are_refused(name, shape):
    optimiser = start()
    tensors = adam_tensors(optimiser) | {name: np.zeros(shape, np.float32)}
    with pytest.raises(InputError) as refused:
        load_adam(optimiser, tensors)
    assert name in str(refused.value) and str(shape) in str(refused.value)


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
        gradient = vjp(lambda x: x * x, x, 3.0)
    np.testing.assert_array_equal(gradient, [6, 12])
    np.testing.assert_array_equal(dr.grad(x), 0)


def test_a_function_that_does_not_depend_on_its_argument_is_refused():
    with pytest.raises(ValueError):
        vjp(lambda x: mi.Float(1, 2), mi.Float(1, 2), 1.0)


@pytest.mark.parametrize("shape", [(), (0,), (7,), (3, 5, 2)])
@pytest.mark.parametrize("kind", [np.uint8, np.float32, np.float64])
def test_aligned_memory_holds_the_same(shape, kind, rng):
    values = rng.uniform(0, 100, shape).astype(kind)
    for part in (values, values.T):
        copy = aligned(part)
        assert not np.shares_memory(copy, part)
        if copy.size:  # an empty array has no memory
            assert copy.ctypes.data % 64 == 0
        np.testing.assert_array_equal(copy, part)
        assert copy.dtype == kind


def test_bytes_are_counted_as_they_are_allocated():
    five, tensor = dr.zeros(mi.Float, 5), mi.TensorXf(dr.zeros(mi.Float, 3), (3, 1))
    assert allocated_bytes(five) == 32
    assert allocated_bytes([dr.zeros(mi.Color3f, 5), (tensor, None, "text")]) == 112
    assert allocated_bytes(Gain(dr.zeros(mi.Color3f, 8), dr.zeros(mi.UInt32, 9))) == 160
    assert allocated_bytes(dr.zeros(mi.Bool, 3)) == 4
    assert allocated_bytes(mi.Float()) == 0
