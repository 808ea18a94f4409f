"""Adam's state as arrays: a run that goes on from them is the run itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drjit.opt import Adam

from mi_nerfattack.backend.adam import adam_tensors, load_adam
from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")

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
    whole, half, resumed = start(), start(), start()
    steps(whole, 0, 5)
    steps(half, 0, 3)
    load_adam(resumed, adam_tensors(half))
    steps(resumed, 3, 5)
    expected = adam_tensors(whole)
    assert {int(expected[f"time.{name}"][0]) for name in NAMES} == {5}
    for name, value in adam_tensors(resumed).items():
        np.testing.assert_array_equal(value, expected[name], name)
    for name in NAMES:
        assert type(resumed[name]) is type(whole[name])
        assert resumed.learning_rate(name) == whole.learning_rate(name)


def test_arrays_are_copies():
    optimiser = start()
    steps(optimiser, 0, 2)
    tensors = adam_tensors(optimiser)
    kept = {name: value.copy() for name, value in tensors.items()}
    load_adam(optimiser, tensors)
    for value in tensors.values():
        value[...] = 7
    for name, value in adam_tensors(optimiser).items():
        np.testing.assert_array_equal(value, kept[name], name)


def test_some_parameters_can_be_loaded_alone():
    optimiser, other = start(), start()
    steps(other, 0, 2)
    before, loaded = adam_tensors(optimiser), adam_tensors(other)
    load_adam(optimiser, loaded, ["flat"])
    for name, value in adam_tensors(optimiser).items():
        expected = loaded if name.endswith("flat") else before
        np.testing.assert_array_equal(value, expected[name], name)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("value.tensor", (3, 2)),
        ("first.tensor", (6,)),
        ("second.flat", (5,)),
        ("value.half", (1, 2)),
        ("time.flat", (2,)),
    ],
)
def test_other_shapes_are_refused(name, shape):
    optimiser = start()
    tensors = adam_tensors(optimiser) | {name: np.zeros(shape, np.float32)}
    with pytest.raises(InputError) as refused:
        load_adam(optimiser, tensors)
    assert name in str(refused.value) and str(shape) in str(refused.value)
