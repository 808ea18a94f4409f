"""The closed loop: sensor, policy, vehicle, sensor, ..."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.rollout.sensor import AbstractSensor, Observation
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.integrators import AbstractIntegrator

OnStep = Callable[[int], None]


@dataclass(frozen=True)
class ClosedLoop:
    """Everything that turns an initial state into a drive.

    Attributes:
        sensor: what the policy sees.
        policy: a policy.AbstractPolicy (named so because this package imports no
            torch): `control(image, goal)` and, for gradients, `vjp`.
        goal: index of the policy's goal.
        dynamics: the vehicle.
        integrator: the time step.
        dt: seconds; the control is held for one step.
    """

    sensor: AbstractSensor
    policy: Any
    goal: int
    dynamics: AbstractDynamics
    integrator: AbstractIntegrator
    dt: float


@dataclass(frozen=True)
class Trajectory:
    """States and controls of a batch of drives.

    Attributes:
        states: horizon + 1 arrays (3, n), metres and radians, evaluated.
        controls: horizon rows (n,), the policy's raw outputs, evaluated.
        observations: what was seen in each step, where it was asked to be kept.
    """

    states: tuple[Any, ...]
    controls: tuple[Any, ...]
    observations: tuple[Observation, ...] = ()

    @property
    def horizon(self) -> int:
        """Number of steps."""
        return len(self.controls)

    def states_numpy(self) -> np.ndarray:
        """States as (n, horizon + 1, 3) float64."""
        return np.stack([np.array(s) for s in self.states], axis=-1).transpose(1, 2, 0)

    def controls_numpy(self) -> np.ndarray:
        """Controls as (n, horizon) float64."""
        return np.stack([np.array(c) for c in self.controls], axis=-1)


def state_type() -> Any:
    """Type of a batch of states for the active variant, double precision."""
    return dr.float64_array_t(mi.Vector3f)


def to_state(states: np.ndarray) -> Any:
    """Upload states (n, 3), metres and radians, as an opaque (3, n) array."""
    states = np.atleast_2d(np.asarray(states, np.float64))
    if states.ndim != 2 or states.shape[1] != 3 or not np.isfinite(states).all():
        raise ValueError(f"states: shape {states.shape}; expected finite (n, 3)")
    result = state_type()(*[np.ascontiguousarray(column) for column in states.T])
    dr.make_opaque(result)
    return result


def simulate(
    loop: ClosedLoop,
    initial: Any,
    horizon: int,
    on_step: OnStep | None = None,
    keep: bool = False,
) -> Trajectory:
    """Drive a batch of vehicles.

    Args:
        loop: the closed loop.
        initial: (3, n) from :func:`to_state`.
        horizon: number of steps, at least 1.
        on_step: called after each step with its index.
        keep: keep all observations, so that a gradient need not render them again;
            about 80 + 20 k bytes a pixel and step for k fields. Otherwise nothing but
            states and controls is kept.
    """
    if horizon < 1:
        raise ValueError(f"horizon: {horizon}; at least 1")
    states, controls, observations = [initial], [], []
    for step in range(horizon):
        seen = loop.sensor.observe(states[-1], step)
        control = dr.value_t(state_type())(loop.policy.control(seen.image, loop.goal))
        applied = loop.dynamics.saturate(control)
        state = loop.integrator.step(loop.dynamics, states[-1], applied, loop.dt)
        dr.eval(state, control)
        states.append(state)
        controls.append(control)
        if keep:
            observations.append(seen)
        if on_step is not None:
            on_step(step)
    return Trajectory(tuple(states), tuple(controls), tuple(observations))
