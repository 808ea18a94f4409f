"""A vehicle that moves by a kinematic model on flat ground."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mi_nerfattack.deploy.vehicle import AbstractVehicle, planar_body, require_control
from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.integrators import AbstractIntegrator
from mi_nerfattack.vehicle.state import to_state
from mi_nerfattack.vehicle.transition import Transition


class KinematicVehicle(AbstractVehicle):
    """Vehicle of a model of `mi_nerfattack.vehicle`.

    Args:
        dynamics: the model; one with a `speed` takes that given to `reset`.
        integrator: its time step.
        period: seconds that a control is held.
        max_control: where the model saturates the control.
        control_unit: "rad/s" (Dubins) or "rad" (models with a steering angle).
        substeps: integration steps a period.
        delay: integration steps until a control takes effect.
    """

    def __init__(
        self,
        dynamics: AbstractDynamics,
        integrator: AbstractIntegrator,
        period: float,
        max_control: float,
        control_unit: str = "rad/s",
        substeps: int = 1,
        delay: int = 0,
    ) -> None:
        self.dynamics, self.integrator = dynamics, integrator
        self.period, self.max_control = period, max_control
        self.control_unit = control_unit
        self.substeps, self.delay = substeps, delay
        self._transitions: dict[float | None, Transition] = {}
        self._transition: Transition | None = None
        self._state: Any = None
        self._controls: list[Any] = []

    def reset(self, pose: np.ndarray, speed: float, seed: int = 0) -> None:
        """Put the vehicle somewhere; `seed` has no effect on it."""
        del seed
        key = speed if "speed" in self.dynamics.__dataclass_fields__ else None
        if key not in self._transitions:
            changed = {} if key is None else {"speed": key}
            self._transitions[key] = Transition(
                replace(self.dynamics, **changed),
                self.integrator,
                self.period,
                self.substeps,
                self.delay,
            )
        self._transition = self._transitions[key]
        extended = self._transition.dynamics.extend(np.asarray(pose, np.float64))
        self._state = to_state(extended)
        self._controls = []

    def advance(self, control: float) -> None:
        """Drive one period."""
        if self._transition is None:
            raise InputError("vehicle: advance comes after reset")
        require_control(control)
        self._controls.append(to_state(np.full((1, 3), control))[0])
        index = len(self._controls) - 1
        older, newer = self._transition.controls(self._controls, index, self._state)
        self._state = self._transition.advance(self._state, older, newer)

    @property
    def state(self) -> np.ndarray:
        """State (m,)."""
        if self._state is None:
            raise InputError("vehicle: it has a state only after reset")
        return np.array(self._state)[:, 0].astype(np.float64)

    @property
    def body_to_world(self) -> np.ndarray:
        """Pose (4, 4) on the ground z = 0."""
        return planar_body(self.state)
