"""Time steps of a vehicle model, and the constraint that each step satisfies.

A step solves `G(x_prev, x, u) = 0` for x. The adjoint method (appendix A.9-A.11)
needs the derivatives of G with respect to all three; `residual` is G, written in
Dr.Jit operations and therefore differentiable in forward and reverse mode.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Count, checked
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.linear import solve_columns


@dataclass(frozen=True)
class AbstractIntegrator(ABC):
    """One-step method with a zero-order hold on the control."""

    @abstractmethod
    def step(self, dynamics: AbstractDynamics, x: Any, u: Any, dt: float) -> Any:
        """Advance the state by one step.

        Args:
            dynamics: vehicle model.
            x: (m, n) state, metres and radians, m the model's `state_size`.
            u: (n,) control held over the step, already saturated.
            dt: seconds.

        Returns:
            (m, n) state; derivatives with respect to `x` and `u` are tracked.
        """

    @abstractmethod
    def residual(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> Any:
        """Evaluate G (m, n), in the state's units, zero where `x` is the step."""

    def check(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> None:
        """Raise `InputError` unless `x` is the step from `x_prev`.

        An explicit step fails only where the model does (`AbstractDynamics.check`).
        May wait for the result: call it outside of what `drjit.freeze` records.
        """
        del x_prev, u, dt
        dynamics.check(x)


@dataclass(frozen=True)
class ExplicitEuler(AbstractIntegrator):
    """`x + dt f(x, u)`: first order, one evaluation. Cheapest; cuts every arc."""

    def step(self, dynamics: AbstractDynamics, x: Any, u: Any, dt: float) -> Any:
        """Advance (m, n) by dt seconds."""
        return x + dt * dynamics.derivative(x, u)

    def residual(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> Any:
        """Evaluate `x - step(x_prev)`."""
        return x - self.step(dynamics, x_prev, u, dt)


@dataclass(frozen=True)
class RK4(AbstractIntegrator):
    """Classical Runge-Kutta method: fourth order, four evaluations."""

    def step(self, dynamics: AbstractDynamics, x: Any, u: Any, dt: float) -> Any:
        """Advance (m, n) by dt seconds."""
        k1 = dynamics.derivative(x, u)
        k2 = dynamics.derivative(x + 0.5 * dt * k1, u)
        k3 = dynamics.derivative(x + 0.5 * dt * k2, u)
        k4 = dynamics.derivative(x + dt * k3, u)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def residual(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> Any:
        """Evaluate `x - step(x_prev)`."""
        return x - self.step(dynamics, x_prev, u, dt)


@dataclass(frozen=True)
@checked("ImplicitMidpoint")
class ImplicitMidpoint(AbstractIntegrator):
    """`x = x_prev + dt f((x_prev + x)/2, u)`: second order, A-stable, symmetric.

    Newton's method with a fixed number of iterations, recorded as one kernel; `check`
    looks at the remaining residual, which waits for the device. Not worth its cost for
    a Dubins car; meant for stiff models of your own.

    Args:
        iterations: Newton iterations; the error squares with each.
    """

    iterations: Count = 6

    def step(self, dynamics: AbstractDynamics, x: Any, u: Any, dt: float) -> Any:
        """Advance (m, n) by dt seconds; call `check` with the result."""
        x_prev, control = dr.detach(x), dr.detach(u)
        x_next = type(x_prev)(x_prev)  # an Euler step overshoots in stiff models
        for _ in range(self.iterations):
            defect = self.residual(dynamics, x_prev, x_next, control, dt)
            columns = self._jacobian(dynamics, x_prev, x_next, control, dt)
            x_next = x_next - solve_columns(columns, defect)
        if not dr.grad_enabled(x, u):
            return x_next
        # One more iteration with a constant Jacobian: the value stays, and its
        # derivative is that of the implicit function, -(dG/dx)^-1 dG/d(x_prev, u).
        columns = self._jacobian(dynamics, x_prev, x_next, control, dt)
        return x_next - solve_columns(
            columns, self.residual(dynamics, x, x_next, u, dt)
        )

    def residual(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> Any:
        """Evaluate `x - x_prev - dt f((x_prev + x)/2, u)`."""
        return x - x_prev - dt * dynamics.derivative(0.5 * (x_prev + x), u)

    def _jacobian(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> list[Any]:
        """Compute the columns of dG/dx = 1 - dt/2 df/dx at the midpoint."""
        columns = dynamics.jacobian(0.5 * (x_prev + x), u)
        for j, column in enumerate(columns):
            column *= -0.5 * dt
            column[j] += 1
        return columns

    def check(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> None:
        """Raise `InputError` unless the residual is a rounding error."""
        dynamics.check(x)
        x_prev, x, u = dr.detach(x_prev), dr.detach(x), dr.detach(u)
        defect = self.residual(dynamics, x_prev, x, u, dt)
        defect, scale = dr.abs(defect), 1 + dr.abs(x_prev) + dr.abs(x)
        defect, scale = dr.max(defect, axis=0), dr.max(scale, axis=0)
        epsilon = dr.epsilon(type(defect))
        if dr.all(defect <= 32 * epsilon * scale):  # false for NaN, too
            return
        worst = dr.max(defect)[0]
        raise InputError(
            f"ImplicitMidpoint: residual {worst:.3g} after {self.iterations} Newton "
            f"iterations at dt = {dt!r} s; take a smaller dt or more iterations"
        )
