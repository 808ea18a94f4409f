"""Attack by gradient: Adam on the textures, through the closed loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.rollout.adjoint import StageCost, replay_gradient
from mi_nerfattack.rollout.loop import ClosedLoop, Trajectory, simulate
from mi_nerfattack.vehicle.route import Route


@dataclass(frozen=True)
class IterationRecord:
    """What one iteration gave, measured before its update.

    Attributes:
        iteration: from 0.
        objective: mean over poses of the summed deviation, metre-steps.
        cross_track_mean_m: mean |e| over steps and poses, metres.
        cross_track_max_m: largest |e|, metres.
    """

    iteration: int
    objective: float
    cross_track_mean_m: float
    cross_track_max_m: float


class GradientAttack:
    """Maximise the deviation of a closed loop by its objects' textures.

    Holds the textures, Adam's moments, the history and the best textures so far;
    everything is in :meth:`tensors`, so that an interrupted attack can go on.

    Cost of an iteration: one drive forward and its replay backward.

    Args:
        loop: closed loop with a differentiable sensor.
        fields: the grid fields of the sensor's objects, whose textures are attacked.
        route: the lane centre, for the record.
        cost: stage cost that is minimised.
        initial: (3, n) initial states.
        horizon: steps of the drive.
        learning_rate: Adam's, in units of the raw colours.
        attached: keep the derivative of the observation by the state.
        keep_frames: keep all frames of a drive, so that they are rendered once, not
            twice; see :func:`simulate` for the memory.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        fields: list[GridField],
        route: Route,
        cost: StageCost,
        initial: Any,
        horizon: int,
        learning_rate: float,
        attached: bool = False,
        keep_frames: bool = False,
    ) -> None:
        self.loop = loop
        self.fields = fields
        self.route = route
        self.cost = cost
        self.initial = initial
        self.horizon = horizon
        self.attached = attached
        self.keep_frames = keep_frames
        self.history: list[IterationRecord] = []
        self.best_mean_m = -1.0
        self.best = [field.texture.numpy().copy() for field in fields]
        self.optimiser = Adam(
            lr=learning_rate,
            params={str(i): field.texture for i, field in enumerate(fields)},
        )

    @property
    def iteration(self) -> int:
        """Number of finished iterations."""
        return len(self.history)

    def step(self, on_step: Callable[[int], None] | None = None) -> IterationRecord:
        """Do one iteration.

        Args:
            on_step: called after each of the 2 x horizon time steps.

        Raises:
            InputError: the gradient is not finite; nothing is updated.
        """
        self._install()
        drive = simulate(
            self.loop, self.initial, self.horizon, on_step, self.keep_frames
        )
        record = self._record(drive)
        gradient = replay_gradient(self.loop, drive, self.cost, self.attached, on_step)
        for i, value in enumerate(gradient.textures):
            if not np.isfinite(value.numpy()).all():
                raise InputError(
                    f"attack iteration {record.iteration}: the gradient of object {i} "
                    "is not finite; check policy and field for NaN"
                )
            dr.set_grad(self.optimiser[str(i)], value)
        self.optimiser.step()
        self.history.append(record)
        return record

    def measure(self) -> IterationRecord:
        """Drive with the present textures, so that the last update counts too."""
        self._install()
        return self._record(simulate(self.loop, self.initial, self.horizon))

    def _install(self) -> None:
        for i, field in enumerate(self.fields):
            field.set_parameter("texture", dr.detach(self.optimiser[str(i)]))

    def restore_best(self) -> None:
        """Give the fields the textures of the iteration with the largest error."""
        for field, texture in zip(self.fields, self.best, strict=True):
            field.set_parameter("texture", texture)

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays."""
        result: dict[str, np.ndarray] = {
            "history": np.array(
                [list(asdict(record).values()) for record in self.history], np.float64
            ).reshape(-1, 4),
            "best_mean_m": np.array([self.best_mean_m]),
        }
        for i in range(len(self.fields)):
            value, _, _, (count, first, second, _) = self.optimiser.state[str(i)]
            result[f"texture.{i}"] = value.numpy().copy()
            result[f"count.{i}"] = np.array([_scalar(count)], np.int64)
            result[f"best.{i}"] = self.best[i]
            if first is not None:
                result[f"first.{i}"] = _numpy(first, value.shape)
                result[f"second.{i}"] = _numpy(second, value.shape)
        return result

    def load_tensors(self, tensors: dict[str, np.ndarray]) -> None:
        """Take over a state written by :meth:`tensors`.

        Raises:
            KeyError: an entry is missing.
        """
        self.history = [
            IterationRecord(int(row[0]), *map(float, row[1:]))
            for row in tensors["history"]
        ]
        self.best_mean_m = float(tensors["best_mean_m"][0])
        for i in range(len(self.fields)):
            key = str(i)
            self.best[i] = np.array(tensors[f"best.{i}"])
            self.optimiser[key] = mi.TensorXf(np.array(tensors[f"texture.{i}"]))
            value, promoted, rate, extra = self.optimiser.state[key]
            if f"first.{i}" in tensors:
                count = type(extra[0])([int(tensors[f"count.{i}"][0])])
                first = _like(extra[1], value, tensors[f"first.{i}"])
                second = _like(extra[2], value, tensors[f"second.{i}"])
                extra = (count, first, second, extra[3])
            self.optimiser.state[key] = (value, promoted, rate, extra)

    def _record(self, drive: Trajectory) -> IterationRecord:
        """Judge a drive with the present textures, and keep them if they are best."""
        states = drive.states_numpy()[:, 1:]
        error = self.route.cross_track_numpy(states.reshape(-1, 3))
        error = np.abs(error).reshape(states.shape[:2])
        objective, mean = float(error.sum(axis=1).mean()), float(error.mean())
        if mean > self.best_mean_m:
            self.best_mean_m = mean
            self.best = [field.texture.numpy().copy() for field in self.fields]
        return IterationRecord(self.iteration, objective, mean, float(error.max()))


def _scalar(value: Any) -> int:
    return int(np.array(value).ravel()[0])


def _numpy(value: Any, shape: Any) -> np.ndarray:
    return np.array(value, np.float32).reshape(shape).copy()


def _like(sample: Any, value: Any, array: np.ndarray) -> Any:
    kind = type(sample) if sample is not None else type(value)
    if dr.is_tensor_v(kind):
        return kind(np.array(array, np.float32))
    return kind(np.array(array, np.float32).ravel())
