"""Vehicle models of the user's own, in Dr.Jit and in torch."""

from __future__ import annotations

import doctest

import drjit as dr
import numpy as np
import pytest
import torch
from support.faults.refusals import refusals
from support.reference import loop as analytic
from support.reference.derivatives import row64, state64

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle import (
    RK4,
    Dubins,
    FunctionDynamics,
    ImplicitMidpoint,
    RateLimitedAckermann,
    user_model,
)
from mi_nerfattack.vehicle.torch_model import TorchDynamics
from mi_nerfattack.vehicle.trial import require_model

pytestmark = pytest.mark.usefixtures("variant")

LAG = RateLimitedAckermann(4.0, 2.5, 0.6, 0.9, 0.15)


def lag_in_drjit(state, control):
    ratio = (control - state[3]) / 0.15 / 0.9
    rate = 0.9 * ratio / (1 + ratio**8) ** 0.125
    sin, cos = dr.sincos(state[2])
    return [4 * cos, 4 * sin, 4 / 2.5 * dr.tan(state[3]), rate]


OWN = {
    "drjit": FunctionDynamics(lag_in_drjit, 4, 0.6),
    "torch": TorchDynamics(analytic.TORCH_VEHICLES["ackermann_rate"], 4, 0.6),
}


@pytest.mark.parametrize("framework", OWN)
@pytest.mark.parametrize(("integrator", "count"), [(RK4(), 1), (ImplicitMidpoint(), 5)])
def test_own_model_equals_ours(framework, count, integrator):
    """Steps, and their derivatives in both modes."""
    rng, own = np.random.default_rng(1), OWN[framework]
    x, t_x, weight = rng.normal(size=(3, 4, count)) * 0.4
    u, t_u = rng.normal(size=(2, count)) * 0.4

    def products(dynamics):
        start, control = state64(x), row64(u)
        dr.enable_grad(start, control)
        end = integrator.step(dynamics, start, dynamics.saturate(control), 0.1)
        integrator.check(dynamics, start, end, dynamics.saturate(control), 0.1)
        value = end.numpy().copy()
        dr.backward(dr.sum(dr.sum(end * state64(weight), axis=0)))
        reverse = dr.grad(start).numpy().copy(), dr.grad(control).numpy().copy()
        start, control = state64(x), row64(u)
        dr.enable_grad(start, control)
        end = integrator.step(dynamics, start, dynamics.saturate(control), 0.1)
        dr.set_grad(start, state64(t_x))
        dr.set_grad(control, row64(t_u))
        return [value, *reverse, dr.forward_to(end).numpy().copy()]

    for actual, expected in zip(products(own), products(LAG), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-11, atol=1e-13)
    assert own.recordable == (framework == "drjit")


def test_what_may_be_returned():
    own = TorchDynamics(lambda x, u: torch.stack([x[:, 0], x[:, 1], u], 1))
    state = dr.llvm.ad.Array3f(1, 2, dr.llvm.ad.Float(3, 4))  # single precision
    rates = own.derivative(state, dr.llvm.ad.Float(0.5, 0.25))
    assert type(rates) is type(state)
    np.testing.assert_array_equal(rates.numpy(), [[1, 1], [2, 2], [0.5, 0.25]])
    own = FunctionDynamics(lambda x, u: (1.5, dr.cos(x[2]), u))  # numbers, single rows
    rates = own.derivative(state64(np.zeros((3, 4))), row64([1, 2, 3, 4]))
    np.testing.assert_array_equal(rates.numpy(), [[1.5] * 4, [1.0] * 4, [1, 2, 3, 4]])
    own = FunctionDynamics(lambda x, u: (dr.abs(x[0]), dr.maximum(x[1], 0), u))  # kinks
    start = state64([[0.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    require_model("own", own, start, row64([0.1, 0.2]))
    assert doctest.testmod(user_model).failed == 0


@pytest.mark.parametrize("kind", [FunctionDynamics, TorchDynamics])
def test_initial_values_of_other_rows(kind):
    poses = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    for rows, own in (
        ([[7, 8]] * 2, kind(len, 5, 1.0, (7.0, 8.0))),
        ([0, 0], kind(len, 4)),
        (np.zeros((2, 0)), kind(len)),
    ):
        np.testing.assert_array_equal(own.extend(poses), np.c_[poses, rows])


F, T = FunctionDynamics, TorchDynamics
REFUSED = (
    ((2,), "size: 2"),
    ((3, 0.0), "limit: 0.0"),
    ((3, 1.0, (1.0,)), "rest_state: .*; 0 finite"),
    ((4, 1.0, (float("nan"),)), r"rest_state: \(nan,\)"),
)
test_arguments_that_are_refused = refusals(
    *(
        (lambda k=k, a=a: k(len, *a), f"{k.__name__}.{w}")
        for k in (F, T)
        for a, w in REFUSED
    )
)


@pytest.mark.parametrize(
    ("kind", "returned", "words"),
    [
        (F, lambda x, u: None, "NoneType"),
        (F, lambda x, u: np.zeros((3, 3)), r"ndarray of shape \(3, 3\)"),
        (F, lambda x, u: ("a", u, u), r"\(str, Float64, Float64\)"),
        (F, lambda x, u: (u, u, row64([1, 2])), r"\[3, 3, 2\] entries"),
        (F, lambda x, u: (x[0], x[1], dr.detach(u)), "derivative"),
        (F, lambda x, u: x[7], r"line \d+"),
        (T, lambda x, u: None, r"NoneType; .*\(3, 3\)"),
        (T, lambda x, u: x[:, :2], r"\(3, 2\)"),
        (T, lambda x, u: x / 0, r"\[inf, inf, inf\] for vehicle 0"),
        (T, lambda x, u: x.detach(), "derivative"),
        (T, lambda x, u: x.wheel, "AttributeError in line"),
    ],
)
def test_what_a_function_must_not_return(kind, returned, words):
    message = rf"{kind.__name__}\(test_user_model.py:<lambda>\): .*{words}"
    own = kind(returned)
    x, u = state64(np.ones((own.state_size, 3))), row64([0.1, 0.2, 0.3])
    dr.enable_grad(u)
    with pytest.raises(InputError, match=message):
        dr.backward(dr.sum(dr.sum(own.derivative(x, u), axis=0)))


def test_states_that_are_not_finite_are_reported():
    own = F(lambda x, u: (x[0], x[1], u / (x[2] - 1)))
    x, u = state64([[0.0, 0.0], [0.0, 0.0], [2.0, 1.0]]), row64([1.0, 1.0])
    end = RK4().step(own, x, u, 0.1)
    with pytest.raises(InputError, match=r"gave .*inf.* for vehicle 1"):
        RK4().check(own, x, end, u, 0.1)
    RK4().check(Dubins(), x, end, u, 0.1)  # ours cannot fail, so nobody waits
