"""What an attack may change: textures, object poses, and the sizes of its steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.attack.texture.colours import AbstractColouring, Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor
from mi_nerfattack.rollout.sweep import Gradient

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class Freedom:
    """Parameters of an attack and their learning rates.

    Attributes:
        texture_rate: Adam's, in colours (sRGB in 0 to 1); None leaves textures alone.
        colouring: makes what is stepped in, of each object's field.
        pose_rate: Adam's, in metres and radians; None leaves poses alone.
        axes: of `AXES`, along and about which objects may move (world axes).
        limit_m: largest shift along an axis; offsets are projected onto it after each
            update.
        limit_rad: largest component of the rotation vector, likewise.

    Raises:
        InputError: nothing is left to change, or an axis is unknown.
    """

    texture_rate: float | None = 0.3
    pose_rate: float | None = None
    axes: tuple[str, ...] = ("x", "y", "yaw")
    limit_m: float = 1.0
    limit_rad: float = 0.5
    colouring: Callable[[GridField], AbstractColouring] = Colours

    def __post_init__(self) -> None:
        if self.texture_rate is None and self.pose_rate is None:
            raise InputError("Freedom: neither textures nor poses may change")
        unknown = sorted(set(self.axes) - set(AXES))
        if unknown or (self.pose_rate is not None and not self.axes):
            raise InputError(f"axes: {list(self.axes)}; some of {', '.join(AXES)}")

    @property
    def mask(self) -> np.ndarray:
        """Which entries of an offset are free, (6,) of 0 and 1."""
        return np.array([float(axis in self.axes) for axis in AXES])

    def project(self, offsets: np.ndarray) -> np.ndarray:
        """Return the nearest offsets (k, 6) within the limits and the free axes."""
        limit = np.repeat([self.limit_m, self.limit_rad], 3)
        return self.mask * np.clip(offsets, -limit, limit)


def offset_gradients(
    sensor: AbstractDifferentiableSensor, gradient: Gradient
) -> np.ndarray:
    """Return the derivative by the offsets of a sensor's objects, (k, 6).

    Args:
        sensor: with the objects where they were.
        gradient: with that by their poses among its parameters.
    """
    pairs = zip(sensor.objects, sensor.pose_keys, strict=True)
    found = [posed.offset_gradient(gradient.parameters[key]) for posed, key in pairs]
    return np.array(found).reshape(-1, 6)
