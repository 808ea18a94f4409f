"""One control period of a vehicle: hold, delay and integration of the control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr

from mi_nerfattack.backend.differentiate import vjp
from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.integrators import AbstractIntegrator


class Transition:
    """The map ``x_t = Phi(x_{t-1}, u_{t-1-lag}, u_{t-2-lag})`` and its derivatives.

    A control is held for one period (zero-order hold) and takes effect `delay`
    integration steps after the image that it answers: with ``delay = lag substeps +
    late``, the first `late` steps of a period still apply the older control. Before
    the first control arrives the vehicle gets the control 0.

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
        self.lag: int = delay // substeps
        self.late: int = delay % substeps
        calls = (self._advance, self._vjp)
        if dynamics.recordable:
            calls = tuple(freeze_method(call, self._sizes) for call in calls)
        self._advance_call, self._vjp_call = calls

    def sources(self, period: int) -> tuple[int, int]:
        """Return the indices of the older and the newer control of a period.

        Negative indices stand for the control 0.
        """
        return period - self.lag - 1, period - self.lag

    def controls(
        self, controls: Sequence[Any], period: int, like: Any
    ) -> tuple[Any, ...]:
        """Pick the older and the newer control (n,) out of a drive's.

        Args:
            controls: raw controls of the periods 0 to `period`, rows (n,).
            period: index.
            like: any state of the drive.
        """
        none = dr.opaque(dr.detached_t(type(like[0])), 0, dr.width(like))
        return tuple(controls[i] if i >= 0 else none for i in self.sources(period))

    def advance(self, state: Any, older: Any, newer: Any) -> Any:
        """Drive one period; (m, n), evaluated, detached.

        Raises:
            InputError: an implicit step did not converge.
        """
        path = self._advance_call(state, older, newer)
        dr.eval(path)
        for i, (before, after) in enumerate(zip(path[:-1], path[1:], strict=True)):
            control = self.dynamics.saturate(older if i < self.late else newer)
            self.integrator.check(self.dynamics, before, after, control, self.dt)
        return path[-1]

    def vjp(
        self, state: Any, older: Any, newer: Any, cotangent: Any
    ) -> tuple[Any, ...]:
        """Multiply (m, n) by the derivatives: those by state, older, newer."""
        result = self._vjp_call(state, older, newer, cotangent)
        dr.eval(result)
        return result

    def _advance(self, state: Any, older: Any, newer: Any) -> list[Any]:
        path = [state]
        for i in range(self.substeps):
            control = self.dynamics.saturate(older if i < self.late else newer)
            path.append(self.integrator.step(self.dynamics, path[-1], control, self.dt))
        return path

    def _vjp(self, state: Any, older: Any, newer: Any, cotangent: Any) -> tuple:
        return vjp(lambda x: self._advance(*x)[-1], (state, older, newer), cotangent)

    def _sizes(self, *arguments: Any) -> list[int]:
        """Return what a recording depends on beside the arguments: their sizes."""
        return [dr.width(x) for x in arguments]
