"""What an attack may change, and how fast: textures, object poses, step sizes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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


#: The last fifth of the iterations is to gain less than this share of the whole gain.
LEAST_GAIN = 0.02
#: Below, a fifth is too few to tell.
_FEWEST = 10


@dataclass(frozen=True)
class Schedule:
    """Learning rates over the iterations.

    They are constant until the attack has converged, or three quarters of
    `max_iterations` are done; then they fall exponentially over a third as many
    iterations as were done till then.

    Attributes:
        max_iterations: in all.
        final_rate: share of the rates that is left at the end.
    """

    max_iterations: int
    final_rate: float = 1.0

    def rate(self, objectives: Sequence[float]) -> float:
        """Return the share of the learning rates after some iterations.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        if turn is None:
            return 1.0
        return float(self.final_rate ** ((len(objectives) - turn + 1) / _fall(turn)))

    def is_over(self, objectives: Sequence[float]) -> bool:
        """Whether to stop.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        done = len(objectives)
        return done >= self.max_iterations or (
            turn is not None and done >= turn + _fall(turn)
        )

    def has_converged(self, objectives: Sequence[float]) -> bool:
        """Whether the rates fell because there was nothing more to gain at full rate.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        return turn is not None and has_settled(objectives[:turn])

    def full(self, objectives: Sequence[float]) -> int:
        """Return how many iterations had the full rates.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        return len(objectives) if turn is None else turn

    def _turn(self, objectives: Sequence[float]) -> int | None:
        """Return after how many iterations the rates began to fall."""
        last = math.ceil(0.75 * self.max_iterations)
        settled = np.flatnonzero(_settled_after(objectives[:last]))
        if len(settled):
            return int(settled[0])
        return last if len(objectives) >= last else None


def has_settled(objectives: Sequence[float]) -> bool:
    """Whether the last fifth of the iterations gained under 2 % of the whole gain.

    The gain is that of the least objective so far on the first one. Nothing has settled
    that gained nothing at all, nor after fewer than ten iterations.

    Args:
        objectives: of each iteration, minimised.
    """
    return bool(_settled_after(objectives)[-1])


def _settled_after(objectives: Sequence[float]) -> np.ndarray:
    """Return :func:`has_settled` after each number of iterations from 0, (n + 1,)."""
    settled = np.zeros(len(objectives) + 1, bool)
    done = np.arange(_FEWEST, len(objectives) + 1)
    if len(done):
        best = np.minimum.accumulate(objectives)
        last = best[done - 1]
        gain, late = best[0] - last, best[done - 1 - done // 5] - last
        settled[done] = (gain > 0) & (late < LEAST_GAIN * gain)
    return settled


def _fall(turn: int) -> int:
    """Return over how many iterations the rates fall."""
    return max(1, turn // 3)
