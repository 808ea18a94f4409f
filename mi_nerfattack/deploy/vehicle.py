"""The interface of simulated vehicles."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.route.polyline import LARGEST_M


class AbstractVehicle(ABC):
    """Vehicle that holds a control for a while.

    Attributes:
        max_control: largest control that has an effect.
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
    """

    max_control: float
    control_unit: str

    @abstractmethod
    def reset(self, pose: np.ndarray, speed: float, seed: int = 0) -> None:
        """Put the vehicle on the ground, driving at its nominal speed.

        Args:
            pose: (3,), x and y in metres, heading in radians.
            speed: metres per second, to be kept.
            seed: of what is random in the vehicle, if anything is.
        """

    @abstractmethod
    def advance(self, control: float) -> None:
        """Hold a control for one period.

        Raises:
            InputError: the control is not finite, or the vehicle was not reset.
        """

    @property
    @abstractmethod
    def state(self) -> np.ndarray:
        """State (m,) float64, m >= 3: x, y (metres), heading (radians), others."""

    @property
    @abstractmethod
    def body_to_world(self) -> np.ndarray:
        """Pose (4, 4): x forward, y left, z up, origin on the ground at x, y."""


def planar_body(state: np.ndarray) -> np.ndarray:
    """Return body_to_world (4, 4) of a state (m,) on the ground z = 0."""
    x, y, theta = state[:3]
    matrix = np.eye(4)
    matrix[:2, 0] = np.cos(theta), np.sin(theta)
    matrix[:2, 1] = -np.sin(theta), np.cos(theta)
    matrix[:2, 3] = x, y
    return matrix


def planar_state(body_to_world: np.ndarray) -> np.ndarray:
    """Return x, y (metres) and heading (radians), (..., 3), of poses (..., 4, 4)."""
    heading = np.arctan2(body_to_world[..., 1, :1], body_to_world[..., 0, :1])
    return np.concatenate([body_to_world[..., :2, 3], heading], -1)


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


def require_control(control: float) -> None:
    """Raise `InputError` unless a control is finite."""
    if not math.isfinite(control):
        raise InputError(f"control: {control}; a policy must return finite numbers")
