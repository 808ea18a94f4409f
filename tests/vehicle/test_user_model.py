"""Vehicle models of the user's own, in Dr.Jit and in torch."""

from __future__ import annotations

import doctest
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
import torch
from helpers import analytic_loop as analytic
from helpers.states import row64, state64

from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum
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
    wanted = (control - state[3]) / 0.15 / 0.9
    rate = 0.9 * wanted / (1 + wanted**8) ** 0.125
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

    for found, expected in zip(products(own), products(LAG), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-13)
    assert own.recordable == (framework == "drjit")


@pytest.mark.parametrize("framework", OWN)
def test_whole_loop_with_an_own_model(framework):
    """The loop's gradient is autograd's through the whole of the loop in torch."""
    ours, twin = analytic.make_pair("ackermann_rate", "rk4", 2, 1)
    loop = replace(ours, dynamics=OWN[framework])
    poses = analytic.random_poses(3)
    initial = torch.tensor(OWN[framework].extend(poses), requires_grad=True)
    texture = torch.tensor(loop.sensor.textures()[0].numpy(), requires_grad=True)
    states, _ = twin.drive(initial, [texture], 6, True)
    cost = (states[:, 1:, 1] ** 2).sum(1).mean()
    expected = torch.autograd.grad(cost, [texture, initial])
    rollout = Rollout(loop, StageSum(lambda x: x[1] * x[1]), 6, attached=True)
    evaluation = rollout.run(loop.initial(poses))
    gradient = rollout.gradient(evaluation)
    assert evaluation.value == pytest.approx(cost.item(), rel=1e-11)
    np.testing.assert_allclose(
        gradient.textures[0].numpy(), expected[0], rtol=1e-8, atol=1e-10
    )
    np.testing.assert_allclose(
        gradient.initial.numpy().T, expected[1], rtol=1e-8, atol=1e-10
    )


def test_example_of_the_docstring():
    assert doctest.testmod(user_model).failed == 0


def test_single_precision_in_torch():
    own = TorchDynamics(lambda x, u: torch.stack([x[:, 0], x[:, 1], u], 1))
    state = dr.llvm.ad.Array3f(1, 2, dr.llvm.ad.Float(3, 4))
    found = own.derivative(state, dr.llvm.ad.Float(0.5, 0.25))
    assert type(found) is type(state)
    np.testing.assert_array_equal(found.numpy(), [[1, 1], [2, 2], [0.5, 0.25]])


def test_numbers_and_single_rows_are_taken():
    own = FunctionDynamics(lambda x, u: (1.5, dr.cos(x[2]), u))
    found = own.derivative(state64(np.zeros((3, 4))), row64([1, 2, 3, 4]))
    np.testing.assert_array_equal(found.numpy(), [[1.5] * 4, [1.0] * 4, [1, 2, 3, 4]])


@pytest.mark.parametrize("kind", [FunctionDynamics, TorchDynamics])
def test_initial_values_of_other_rows(kind):
    poses = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(
        kind(len, 5, 1.0, (7.0, 8.0)).extend(poses), np.c_[poses, [[7, 8], [7, 8]]]
    )
    np.testing.assert_array_equal(kind(len, 4).extend(poses), np.c_[poses, [0, 0]])
    np.testing.assert_array_equal(kind(len).extend(poses), poses)


@pytest.mark.parametrize("kind", [FunctionDynamics, TorchDynamics])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((2,), r"size: 2; .* at least 3"),
        ((3, 0.0), r"limit: 0.0"),
        ((3, 1.0, (1.0,)), r"rest: .*; 0 finite"),
        ((5, 1.0, (1.0,)), r"rest: .*; 2 finite"),
        ((4, 1.0, (float("nan"),)), r"rest: \(nan,\)"),
    ],
)
def test_own_models_reject_parameters(kind, arguments, words):
    with pytest.raises(InputError, match=f"{kind.__name__}.{words}"):
        kind(len, *arguments)


def call(own):
    """Evaluate at three vehicles, differentiating by the control."""
    x, u = state64(np.ones((own.state_size, 3))), row64([0.1, 0.2, 0.3])
    dr.enable_grad(u)
    dr.backward(dr.sum(dr.sum(own.derivative(x, u), axis=0)))


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        (lambda x, u: None, "returned NoneType; 3 rows"),
        (lambda x, u: 5.0, "returned float"),
        (lambda x, u: u, "returned Float64"),
        (lambda x, u: [x[0], u], "returned 2 rows; 3 rows"),
        (lambda x, u: np.zeros((3, 3)), r"returned ndarray of shape \(3, 3\)"),
        (lambda x, u: ("a", u, u), r"rows \(str, Float64, Float64\)"),
        (lambda x, u: (u, u, row64([1, 2])), r"rows of \[3, 3, 2\] entries"),
        (lambda x, u: (x[0], x[1], dr.detach(u)), "no derivative by the control"),
        (lambda x, u: x[7], r"raised \w+ in line \d+"),
    ],
)
def test_what_a_function_must_not_return(returned, words):
    message = rf"FunctionDynamics\(test_user_model.py:<lambda>\): .*{words}"
    with pytest.raises(InputError, match=message):
        call(FunctionDynamics(returned))


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        (lambda x, u: None, r"returned NoneType; a tensor \(3, 3\)"),
        (lambda x, u: x[:, :2], r"returned Tensor of shape \(3, 2\)"),
        (lambda x, u: x / 0, r"gave \[inf, inf, inf\] for vehicle 0"),
        (lambda x, u: x.detach(), "no derivative by the control"),
        (lambda x, u: 2 * x, "no derivative by the control"),
        (lambda x, u: x @ u, "returned Tensor of shape"),
        (lambda x, u: x.wheel, "raised AttributeError in line"),
    ],
)
def test_what_a_torch_function_must_not_return(returned, words):
    message = rf"TorchDynamics\(test_user_model.py:<lambda>\): .*{words}"
    with pytest.raises(InputError, match=message):
        call(TorchDynamics(returned))


def test_states_that_are_not_finite_are_reported():
    own = FunctionDynamics(lambda x, u: (x[0], x[1], u / (x[2] - 1)))
    x, u = state64([[0.0, 0.0], [0.0, 0.0], [2.0, 1.0]]), row64([1.0, 1.0])
    end = RK4().step(own, x, u, 0.1)
    with pytest.raises(InputError, match=r"gave .*inf.* for vehicle 1"):
        RK4().check(own, x, end, u, 0.1)
    RK4().check(Dubins(), x, end, u, 0.1)  # ours cannot fail, so nobody waits


def test_trial_does_not_mind_kinks():
    own = FunctionDynamics(lambda x, u: (dr.abs(x[0]), dr.maximum(x[1], 0), u))
    start = state64([[0.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    require_model("own", own, start, row64([0.1, 0.2]))
