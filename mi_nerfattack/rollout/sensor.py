"""What a policy sees: the interface of sensors that turn vehicle states into images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.fields.grid import GridField


@dataclass(frozen=True)
class Observation:
    """One image a vehicle, and what is needed to look closer at it.

    Attributes:
        image: tensor (n, height, width, 3), sRGB in [0, 1], evaluated.
        step: index of the control period.
        linear: (3, n height width), before the sRGB curve; None where the sensor has
            no derivatives.
        kept: what the scene's integrator hands to its derivatives.
        view: rays and their weights.
    """

    image: Any
    step: int = 0
    linear: Any = None
    kept: Any = None
    view: Any = None

    def __repr__(self) -> str:
        count, height, width, _ = self.image.shape
        return f"Observation({count} images {width}x{height})"


class AbstractSensor(ABC):
    """Camera on a vehicle in some world."""

    @abstractmethod
    def observe(self, state: Any, step: int) -> Observation:
        """Render what vehicles see.

        Args:
            state: (m, n), its first rows px, py (metres) and theta (radians); taken
                as a constant.
            step: index of the control period, from 0; seeds what is random.
        """


class AbstractDifferentiableSensor(AbstractSensor):
    """Sensor whose image can be differentiated by its parameters and by the state.

    Parameters are the texture of each object and, for sensors that have them, the
    objects' poses.
    """

    @abstractmethod
    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """Accumulate the parameters' gradients and return the state's.

        Args:
            observation: from ``observe`` with the same state and step; there may
                have been others since.
            state: (m, n), as given to ``observe``.
            d_image: derivative of the objective by the image, of its shape.
            attached: whether to differentiate by the state.

        Returns:
            (3, n) derivative by px, py and theta; None when not `attached`.
        """

    @abstractmethod
    def start_gradient(self, poses: bool = False) -> None:
        """Set all accumulated gradients to zero.

        Args:
            poses: whether to accumulate those of the objects' poses, too.
        """

    def gradients(self) -> dict[str, Any]:
        """Return what has been accumulated by key of a scene's parameters, if any."""
        return {}

    def stop_gradient(self) -> None:
        """Leave no parameter attached, when the gradients have been read."""
        return

    @property
    @abstractmethod
    def fields(self) -> Sequence[GridField]:
        """The fields whose textures are attacked."""

    @abstractmethod
    def texture_gradients(self) -> list[Any]:
        """Return what has been accumulated, one tensor (n_vertices, 3) an object."""

    @abstractmethod
    def textures(self) -> list[Any]:
        """Return the textures, one tensor (n_vertices, 3) an object, raw colours."""

    @abstractmethod
    def set_textures(self, textures: list[Any]) -> None:
        """Replace the textures: one array (n_vertices, 3) an object, raw colours."""

    def offsets(self) -> np.ndarray | None:
        """Return the objects' offsets, as :meth:`set_offsets` takes them.

        None where objects cannot be moved.
        """
        return None

    def set_offsets(self, offsets: np.ndarray) -> None:
        """Move the objects from where they were put.

        Args:
            offsets: (k, 6), a row an object: shift (metres, world axes), then rotation
                vector (radians, world axes) about the object's origin.

        Raises:
            TypeError: the sensor's objects cannot be moved.
        """
        raise TypeError(
            f"{type(self).__name__}: objects cannot be moved; leave offsets out, or "
            "attack textures alone"
        )

    def offset_gradients(self) -> np.ndarray:
        """Return the accumulated derivatives by the offsets, (k, 6).

        Raises:
            TypeError: the sensor's objects cannot be moved.
        """
        raise TypeError(
            f"{type(self).__name__}: has no derivative by object pose; attack textures "
            "alone"
        )

    def keep(self, observation: Observation) -> Any:
        """Return what a backward pass must have kept to call :meth:`restore`."""
        return observation

    def restore(self, state: Any, step: int, kept: Any) -> Observation:
        """Return an observation from what :meth:`keep` gave.

        Args:
            state: (m, n), as given to ``observe``.
            step: likewise.
            kept: of that observation.
        """
        del state, step
        return kept
