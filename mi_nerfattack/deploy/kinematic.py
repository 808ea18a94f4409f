"""A vehicle that moves by a kinematic model on flat ground."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mi_nerfattack.deploy.vehicle import AbstractVehicle, planar_body, require_control
from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.integrators import RK4, AbstractIntegrator
from mi_nerfattack.vehicle.state import to_state
from mi_nerfattack.vehicle.transition import Transition


@dataclass(frozen=True)
class Motion:
    """How a vehicle without wheels moves.

    Args:
        dynamics: the model.
        integrator: its time step.
        substeps: integration steps a period.
        delay: integration steps until a control takes effect.
    """

    dynamics: AbstractDynamics
    integrator: AbstractIntegrator = field(default_factory=RK4)
    substeps: int = 1
    delay: int = 0


class KinematicVehicle(AbstractVehicle):
    """Vehicle of a model of `mi_nerfattack.vehicle`.

    Args:
        motion: the model, whose `speed`, where it has one, is that given to `reset`.
        period: seconds that a control is held.
        max_control: where the model saturates the control.
        control_unit: "rad/s" (Dubins) or "rad" (models with a steering angle).
    """

    def __init__(
        self,
        motion: Motion,
        period: float,
        max_control: float,
        control_unit: str = "rad/s",
    ) -> None:
        self.motion = motion
        self.period, self.max_control = period, max_control
        self.control_unit = control_unit
        self._transitions: dict[float | None, Transition] = {}
        self._transition: Transition | None = None
        self._state: Any = None
        self._controls: list[Any] = []

    def reset(self, pose: np.ndarray, speed: float, seed: int = 0) -> None:
        """Put the vehicle somewhere; `seed` has no effect on it."""
        del seed
        motion = self.motion
        key = speed if "speed" in motion.dynamics.__dataclass_fields__ else None
        if key not in self._transitions:
            changed = {} if key is None else {"speed": key}
            self._transitions[key] = Transition(
                replace(motion.dynamics, **changed),
                motion.integrator,
                self.period,
                motion.substeps,
                motion.delay,
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
