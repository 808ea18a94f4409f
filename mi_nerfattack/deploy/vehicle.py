"""Simulated vehicles: the interface, and the kinematic models."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mi_nerfattack.deploy.car import Control, control_names
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import planar_body
from mi_nerfattack.vehicle.dynamics import (
    AbstractDynamics,
    require_controls,
    to_control,
    to_state,
)
from mi_nerfattack.vehicle.integrators import RK4, AbstractIntegrator, Transition
from mi_nerfattack.vehicle.route.polyline import LARGEST_M

#: One control, or one number for each of several.
Controls = float | Sequence[float] | np.ndarray


class AbstractVehicle(ABC):
    """Vehicle that holds a control for a while.

    Attributes:
        max_control: largest control that has an effect; of several, the first one's.
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
        more_controls: those after the first one.
        reference: how far ahead of the rear axle the point of the state is, metres.
    """

    max_control: float
    control_unit: str
    more_controls: tuple[Control, ...] = ()
    reference: float = 0.0

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls, in their order."""
        return control_names(self.control_unit, self.more_controls)

    @abstractmethod
    def reset(self, pose: np.ndarray, speed: float, seed: int = 0) -> None:
        """Put the vehicle on the ground, driving at its nominal speed.

        Args:
            pose: (3,), x and y in metres, heading in radians.
            speed: metres per second, to be kept.
            seed: of what is random in the vehicle, if anything is.
        """

    @abstractmethod
    def advance(self, control: Controls) -> None:
        """Hold a control, or one number for each of several, for one period.

        Raises:
            InputError: the control is not finite, there are more or fewer than the
                vehicle takes, or it was not reset.
        """

    @property
    @abstractmethod
    def state(self) -> np.ndarray:
        """State (m,) float64, m >= 3: x, y (metres), heading (radians), others."""

    @property
    @abstractmethod
    def speed(self) -> float:
        """Speed along the heading, metres per second."""

    @property
    @abstractmethod
    def body_to_world(self) -> np.ndarray:
        """Pose (4, 4): x forward, y left, z up, origin on the ground at x, y."""


def checked_pose(pose: Any) -> np.ndarray:
    """Copy a vehicle's pose x, y (metres), theta (radians) to (3,) float64.

    Raises:
        InputError: it is not three finite numbers of at most `LARGEST_M`.
    """
    allowed = f"three finite numbers x, y, theta, at most {LARGEST_M:g}"
    try:
        array = np.array(pose, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"pose: {pose!r}; {allowed}") from error
    if array.shape != (3,) or not (np.abs(array) <= LARGEST_M).all():
        raise InputError(f"pose: {array.tolist()}; {allowed}")
    return array


def checked_control(control: Controls, names: Sequence[str]) -> np.ndarray:
    """Copy controls to (k,) float64.

    Args:
        control: one number, or k.
        names: of the k controls that are taken.

    Raises:
        InputError: a number is not finite, or there are not k.
    """
    values = np.array(control, np.float64).reshape(-1)
    require_controls(len(values), names)
    if not np.isfinite(values).all():
        raise InputError(f"control: {control}; a policy must return finite numbers")
    return values


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
        more_controls: of the model, after the first one.
        reference: how far ahead of the rear axle the model's point is, metres.

    Raises:
        InputError: the model takes another number of controls.
    """

    def __init__(
        self,
        motion: Motion,
        period: float,
        max_control: float,
        control_unit: str = "rad/s",
        more_controls: tuple[Control, ...] = (),
        reference: float = 0.0,
    ) -> None:
        if motion.dynamics.control_size != 1 + len(more_controls):
            names = ", ".join(motion.dynamics.control_names)
            raise InputError(
                f"more_controls: {len(more_controls)}; the model takes {names}: give "
                "one Control for each name after the first"
            )
        self.motion, self.more_controls = motion, more_controls
        self.period, self.max_control = period, max_control
        self.control_unit, self.reference = control_unit, reference
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
                substeps=motion.substeps,
                delay=motion.delay,
            )
        self._transition = self._transitions[key]
        extended = self._transition.dynamics.extend(np.asarray(pose, np.float64))
        self._state = to_state(extended)
        self._controls = []

    def advance(self, control: Controls) -> None:
        """Drive one period."""
        if self._transition is None:
            raise InputError("vehicle: advance comes after reset")
        values = checked_control(control, self.control_names)
        self._controls.append(to_control(values[None]))
        index = len(self._controls) - 1
        acting = self._transition.controls(self._controls, index, self._state)
        self._state = self._transition.advance(self._state, *acting)

    @property
    def state(self) -> np.ndarray:
        """State (m,)."""
        if self._state is None:
            raise InputError("vehicle: it has a state only after reset")
        return np.array(self._state)[:, 0].astype(np.float64)

    @property
    def speed(self) -> float:
        """Speed of the model."""
        if self._transition is None:
            raise InputError("vehicle: it has a speed only after reset")
        return float(self._transition.dynamics.speed_of(self._state)[0])

    @property
    def body_to_world(self) -> np.ndarray:
        """Pose (4, 4) on the ground z = 0."""
        return planar_body(self.state)
