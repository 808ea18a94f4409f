"""Adjoint of the closed loop by replay: memory that does not grow with the drive.

For an objective ``J = mean_n sum_t C(x_t)`` under ``G_t(x_{t-1}, x_t, theta) = 0``,
``(dG_t/dx_t)^T l_t = -(dC/dx_t)^T - (dG_{t+1}/dx_t)^T l_{t+1}`` is solved backwards
from ``l_{T+1} = 0``, and ``dJ/dtheta = sum_t l_t^T dG_t/dtheta``. Each step renders
its frame again, so that between steps only states, controls and one gradient buffer
exist. Cost of a step: one more observation (none where the trajectory kept them), one
product with the policy's derivative and one march derivative. Source: appendix A.9 to
A.12.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.rollout.loop import ClosedLoop, OnStep, Trajectory, state_type
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor
from mi_nerfattack.vehicle.integrators import solve_columns

StageCost = Callable[[Any], Any]


@dataclass(frozen=True)
class Gradient:
    """Derivatives of an objective.

    Attributes:
        textures: one tensor (n_vertices, 3) an object.
        initial: (3, n) by the initial states.
        costates: (horizon, n, 3) l_t, NumPy.
    """

    textures: list[Any]
    initial: Any
    costates: np.ndarray


def objective_value(trajectory: Trajectory, cost: StageCost) -> float:
    """Evaluate ``mean_n sum_{t>=1} C(x_t)``."""
    total = 0.0
    for state in trajectory.states[1:]:
        total += float(np.mean(np.array(cost(state))))
    return total


def replay_gradient(
    loop: ClosedLoop,
    trajectory: Trajectory,
    cost: StageCost,
    attached: bool = False,
    on_step: OnStep | None = None,
) -> Gradient:
    """Differentiate ``mean_n sum_t C(x_t)`` by the textures and initial states.

    Args:
        loop: as it was when it gave `trajectory`; its sensor differentiable.
        trajectory: from :func:`simulate`.
        cost: C, maps states (3, n) to (n,), differentiable by Dr.Jit.
        attached: keep the derivative of the observation by the state (its default
            is A.12, which stops it). Only attached gradients are those of the
            whole loop.
        on_step: called after each step with its index.

    Raises:
        TypeError: the sensor is not differentiable.
    """
    sensor = loop.sensor
    if not isinstance(sensor, AbstractDifferentiableSensor):
        raise TypeError(f"{type(sensor).__name__}: has no derivatives")
    count = dr.width(trajectory.states[0])
    carry = dr.opaque(state_type(), 0, count)  # (dG_{t+1}/dx_t)^T l_{t+1}
    costates = []
    sensor.start_gradient()
    for step in reversed(range(trajectory.horizon)):
        before, after = trajectory.states[step], trajectory.states[step + 1]
        right = -_cost_gradient(cost, after, count) - carry
        costate = _solve(loop, before, after, trajectory.controls[step], right)
        dr.eval(costate)
        d_before, d_control = _residual_vjp(
            loop, before, after, trajectory.controls[step], costate
        )
        kept = trajectory.observations
        seen = kept[step] if kept else sensor.observe(before, step)
        row = dr.array_t(seen.image)
        _, d_image = loop.policy.vjp(seen.image, loop.goal, row(d_control))
        d_state = sensor.vjp(seen, before, d_image, attached)
        carry = d_before if d_state is None else d_before + d_state
        dr.eval(carry)
        costates.append(np.array(costate).T)
        if on_step is not None:
            on_step(step)
    gradients = sensor.texture_gradients()
    return Gradient(gradients, carry, np.stack(costates[::-1]))


def _cost_gradient(cost: StageCost, state: Any, count: int) -> Any:
    leaf = type(state)(state)
    dr.enable_grad(leaf)
    dr.backward_from(cost(leaf) / count)
    return dr.grad(leaf)


def _residual(loop: ClosedLoop, before: Any, after: Any, control: Any) -> Any:
    applied = loop.dynamics.saturate(control)
    return loop.integrator.residual(loop.dynamics, before, after, applied, loop.dt)


def _residual_vjp(
    loop: ClosedLoop, before: Any, after: Any, control: Any, costate: Any
) -> tuple[Any, Any]:
    """Return ``(dG/dx_{t-1})^T l`` and ``(dG/du)^T l``."""
    leaf, control_leaf = type(before)(before), type(control)(control)
    dr.enable_grad(leaf, control_leaf)
    dr.backward_from(dr.dot(_residual(loop, leaf, after, control_leaf), costate))
    result = dr.grad(leaf), dr.grad(control_leaf)
    dr.eval(result)
    return result


def _solve(loop: ClosedLoop, before: Any, after: Any, control: Any, right: Any) -> Any:
    """Solve ``(dG_t/dx_t)^T l = right``."""
    if loop.integrator.explicit:
        return right
    rows = []
    for axis in range(3):
        leaf = type(after)(after)
        dr.enable_grad(leaf)
        dr.backward_from(_residual(loop, before, leaf, control)[axis])
        rows.append(dr.grad(leaf))
    return solve_columns(rows, right)
