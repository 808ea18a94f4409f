"""Time steps of a vehicle model, and the constraint that each step satisfies.

A step solves `G(x_prev, x, u) = 0` for x. The adjoint method (appendix A.9-A.11)
needs the derivatives of G with respect to all three; `residual` is G, written in
Dr.Jit operations and therefore differentiable in forward and reverse mode.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.backend.arrays import vjp
from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Count, checked
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, no_control


def solve_columns(columns: list[Any], right: Any) -> Any:
    """Solve n systems of m equations by Gaussian elimination with row pivots.

    Unrolled while it is traced: about `m^3` operations a system, meant for m below 10.

    Args:
        columns: m columns, each (m, n), of matrices that are not near singular.
        right: (m, n).

    Returns:
        (m, n); differentiable in all arguments, in forward and reverse mode.
    """
    size = len(columns)
    # Augmented rows; those above the diagonal are final.
    rows = [[c[i] for c in columns] + [right[i]] for i in range(size)]
    for k in range(size):
        # The row with the largest entry in column k becomes the pivot
        for i in range(k + 1, size):
            rows[k], rows[i] = _larger_first(rows[k], rows[i], k)
        # Eliminate column k from the rows below it
        for i in range(k + 1, size):
            factor = rows[i][k] / rows[k][k]
            for j in range(k + 1, size + 1):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    return type(right)(*_substitute(rows))


def _larger_first(
    first: list[Any], second: list[Any], k: int
) -> tuple[list[Any], list[Any]]:
    """Swap two rows where the second has the larger entry in column k."""
    swap = dr.abs(second[k]) > dr.abs(first[k])
    pairs = list(zip(first, second, strict=True))
    done = first[:k]  # eliminated columns are never read again
    return (
        done + [dr.select(swap, b, a) for a, b in pairs[k:]],
        done + [dr.select(swap, a, b) for a, b in pairs[k:]],
    )


def _substitute(rows: list[list[Any]]) -> list[Any]:
    """Solve an upper triangular system, last row first."""
    size = len(rows)
    solution: list[Any] = [None] * size
    for i in reversed(range(size)):
        remainder = rows[i][size]
        for j in range(i + 1, size):
            remainder = remainder - rows[i][j] * solution[j]
        solution[i] = remainder / rows[i][i]
    return solution


@dataclass(frozen=True)
class AbstractIntegrator(ABC):
    """One-step method with a zero-order hold on the control."""

    @abstractmethod
    def step(self, dynamics: AbstractDynamics, x: Any, u: Any, dt: float) -> Any:
        """Advance the state by one step.

        Args:
            dynamics: vehicle model.
            x: (m, n) state, metres and radians, m the model's `state_size`.
            u: (n,) or (k, n) control held over the step, already saturated.
            dt: seconds.

        Returns:
            (m, n) state; derivatives with respect to `x` and `u` are tracked.
        """

    def residual(
        self, dynamics: AbstractDynamics, x_prev: Any, x: Any, u: Any, dt: float
    ) -> Any:
        """Evaluate G (m, n), in the state's units, zero where `x` is the step."""
        return x - self.step(dynamics, x_prev, u, dt)

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
        # Newton's method on G(x_prev, x, u) = 0, with all inputs detached
        x_prev, control = dr.detach(x), dr.detach(u)
        x_next = type(x_prev)(x_prev)  # an Euler step overshoots in stiff models
        for _ in range(self.iterations):
            defect = self.residual(dynamics, x_prev, x_next, u=control, dt=dt)
            columns = self._jacobian(dynamics, x_prev, x_next, u=control, dt=dt)
            x_next = x_next - solve_columns(columns, defect)
        if not dr.grad_enabled(x, u):
            return x_next
        # One more iteration with a constant Jacobian: the value stays, and its
        # derivative is that of the implicit function, -(dG/dx)^-1 dG/d(x_prev, u).
        columns = self._jacobian(dynamics, x_prev, x_next, u=control, dt=dt)
        return x_next - solve_columns(
            columns, self.residual(dynamics, x, x_next, u=u, dt=dt)
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
        defect = self.residual(dynamics, x_prev, x, u=u, dt=dt)
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


class Transition:
    """The map ``x_t = Phi(x_{t-1}, u_{t-1-lag}, u_{t-2-lag})`` and its derivatives.

    A control is held for one period (zero-order hold) and takes effect `delay`
    integration steps after the image that it answers: with ``delay = lag substeps +
    late``, the first `late` steps of a period still apply the older control. Before
    the first control arrives the vehicle gets the control 0.

    Where the vehicles of a batch have delays (`AbstractDynamics.delays`), these add to
    `delay`, and more than two controls may act in a period. A delay need not be a whole
    number of steps. With a delay of ``n + f`` steps, an integration step applies the
    mean of the controls that arrive during the step. This mean is ``f`` times the
    control from n + 1 steps ago plus ``1 - f`` times the control from n steps ago. The
    derivative by the controls follows; there is no derivative by a delay.

    Args:
        dynamics: the vehicle.
        integrator: its time step.
        period: seconds between two images.
        substeps: integration steps a period, at least 1.
        delay: integration steps, at least 0.

    Raises:
        ValueError: a count is out of range.
    """

    def __init__(
        self,
        dynamics: AbstractDynamics,
        integrator: AbstractIntegrator,
        period: float,
        substeps: int = 1,
        delay: int = 0,
    ) -> None:
        if substeps < 1:
            raise ValueError(f"substeps: {substeps}; at least 1")
        if delay < 0:
            raise ValueError(f"delay: {delay}; at least 0 integration steps")
        self.dynamics = dynamics
        self.integrator = integrator
        self.dt: float = period / substeps
        self.substeps = substeps
        self.delay = delay
        self.lag: int = delay // substeps
        self.late: int = delay % substeps
        self._shares: dict[Any, Shares | None] = {}
        calls = (self._advance, self._vjp)
        if dynamics.recordable:
            calls = tuple(freeze_method(call, self._beside) for call in calls)
        self._advance_call, self._vjp_call = calls

    def sources(self, period: int, like: Any) -> range:
        """Return the indices of the controls that act in a period, oldest first.

        A negative index means the control 0.

        Args:
            period: index.
            like: any state (m, n) of the drive.
        """
        shares = self.shares(like)
        oldest = self.lag + 1 if shares is None else shares.oldest
        newest = self.lag if shares is None else shares.newest
        return range(period - oldest, period - newest + 1)

    def controls(
        self, controls: Sequence[Any], period: int, like: Any
    ) -> tuple[Any, ...]:
        """Pick the controls that act in a period out of a drive's, oldest first.

        Args:
            controls: raw controls of the periods 0 to `period`, (n,) or (k, n).
            period: index.
            like: any state of the drive.
        """
        none = no_control(self.dynamics.control_size, like)
        sources = self.sources(period, like)
        return tuple(controls[i] if i >= 0 else none for i in sources)

    def advance(self, state: Any, *controls: Any) -> Any:
        """Drive one period; (m, n), evaluated, detached.

        Args:
            state: (m, n), before it.
            controls: as :meth:`controls` picks them.

        Raises:
            InputError: an implicit step did not converge.
        """
        path = self._advance_call(state, *controls)
        dr.eval(path)
        for i, (before, after) in enumerate(zip(path[:-1], path[1:], strict=True)):
            acting = self._acting(i, state, controls)
            self.integrator.check(self.dynamics, before, after, acting, self.dt)
        return path[-1]

    def vjp(
        self, state: Any, controls: Sequence[Any], cotangent: Any
    ) -> tuple[Any, ...]:
        """Multiply (m, n) by the derivatives: those by state and each control."""
        result = self._vjp_call(state, cotangent, *controls)
        dr.eval(result)
        return result

    def shares(self, like: Any) -> Shares | None:
        """Return what share each control has; None where two act in turn.

        Args:
            like: any state (m, n) of the drive.
        """
        key = kind, count = dr.detached_t(type(like[0])), dr.width(like)
        if key not in self._shares:
            delays_s = self.dynamics.delays(count)
            self._shares[key] = None
            if delays_s is not None:
                steps = self.delay + delays_s / self.dt
                self._shares[key] = Shares.of(steps, self.substeps, kind)
        return self._shares[key]

    def _acting(self, step: int, state: Any, controls: Sequence[Any]) -> Any:
        """Return the saturated control of an integration step."""
        shares = self.shares(state)
        if shares is None:
            return self.dynamics.saturate(controls[0 if step < self.late else 1])
        # The mean of the controls that arrive in the step, by their shares
        first, *others = zip(shares.weights[step], controls, strict=True)
        command = first[0] * first[1]
        for weight, control in others:
            command = command + weight * control
        return self.dynamics.saturate(command)

    def _advance(self, state: Any, *controls: Any) -> list[Any]:
        path = [state]
        for i in range(self.substeps):
            acting = self._acting(i, state, controls)
            path.append(self.integrator.step(self.dynamics, path[-1], acting, self.dt))
        return path

    def _vjp(self, state: Any, cotangent: Any, *controls: Any) -> tuple:
        inputs = state, *controls
        return vjp(lambda x: self._advance(*x)[-1], inputs, cotangent)

    def _beside(self, state: Any, *inputs: Any) -> list[Any]:
        """Return what a recording depends on beside the arguments, their sizes too."""
        sizes, shares = [dr.width(x) for x in (state, *inputs)], self.shares(state)
        weights = [] if shares is None else shares.weights
        return [sizes, self.dynamics.constants(state), weights]


@dataclass(frozen=True)
class Shares:
    """Shares of the latest controls in each integration step of a period.

    Attributes:
        oldest: control periods from the first control's to the period.
        newest: from the last control's, at least 0.
        weights: of each step and control, oldest first: (n,), opaque, in [0, 1].
    """

    oldest: int
    newest: int
    weights: list[list[Any]]

    @classmethod
    def of(cls, delays: np.ndarray, substeps: int, kind: Any) -> Shares:
        """Compute shares.

        Args:
            delays: (n,) of n vehicles, integration steps, at least 0.
            substeps: integration steps a period.
            kind: type of a row of their states.
        """
        full_steps = np.floor(delays)
        part, step = delays - full_steps, np.arange(substeps)[:, None]
        # periods since the two controls that arrive in a step, (substeps, n)
        later, earlier = (
            -((step - n) // substeps) for n in (full_steps, full_steps + 1)
        )
        # The range of ages over all vehicles and steps
        newest, oldest = int(later.min()), int(earlier.max())
        ages = np.arange(oldest, newest - 1, -1)[:, None]
        # 1 - f of the later control, f of the earlier one
        weights = [
            [
                kind(row.tolist())
                for row in (1 - part) * (ages == a) + part * (ages == b)
            ]
            for a, b in zip(later, earlier, strict=True)
        ]
        dr.make_opaque(weights)
        return cls(oldest, newest, weights)
