"""Attack by gradient: Adam on textures and poses, through the closed loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from mi_nerfattack.attack.parameters import Freedom
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.cost import Cost
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import Trajectory, simulate
from mi_nerfattack.rollout.sweep import Gradient, differentiable
from mi_nerfattack.vehicle.route import Route

OFFSETS = "offsets"


@dataclass(frozen=True)
class IterationRecord:
    """What one iteration gave, measured before its update.

    Attributes:
        iteration: from 0.
        objective: the cost that is minimised, reduced over the poses.
        cross_track_mean_m: mean |e| over steps and poses, metres.
        cross_track_max_m: largest |e|, metres.
    """

    iteration: int
    objective: float
    cross_track_mean_m: float
    cross_track_max_m: float


class GradientAttack:
    """Minimise a cost of the closed loop by its objects' textures and poses.

    Holds the parameters, Adam's moments, the history and the best parameters so far;
    everything is in :meth:`tensors`, so that an interrupted attack can go on. No
    random numbers are drawn.

    Cost of an iteration: one drive forward and one backward; see the adjoint.

    Args:
        rollout: the loop, its objective and its adjoint.
        route: the lane centre, for the record.
        initial: (m, n) initial states.
        freedom: what may change.

    Attributes:
        history: a record an iteration.
        best: textures of the iteration with the least objective.
        best_offsets: (k, 6) object offsets of the same.
        best_mean_m: mean |e| of the same, metres.
    """

    def __init__(
        self,
        rollout: Rollout,
        route: Route,
        initial: Any,
        freedom: Freedom | None = None,
    ) -> None:
        self.rollout = rollout
        self.route = route
        self.initial = initial
        self.freedom = freedom or Freedom()
        self.sensor = differentiable(rollout.loop)
        self.history: list[IterationRecord] = []
        self.best_objective = np.inf
        self.best_mean_m = 0.0
        self.best = self._textures()
        self.optimiser = Adam(lr=self.freedom.texture_rate or self.freedom.pose_rate)
        if self.freedom.texture_rate is not None:
            for i, texture in enumerate(self.sensor.textures()):
                self.optimiser[str(i)] = texture
        self.best_offsets = np.zeros((len(self.best), 6))
        if self.freedom.pose_rate is not None:
            self.best_offsets = self.sensor.offsets()
            self.optimiser[OFFSETS] = _tensor(self.best_offsets)
            self.optimiser.set_learning_rate({OFFSETS: self.freedom.pose_rate})

    @property
    def iteration(self) -> int:
        """Number of finished iterations."""
        return len(self.history)

    def step(self, on_step: Callable[[int], None] | None = None) -> IterationRecord:
        """Do one iteration.

        Args:
            on_step: called after each of the 2 x horizon control periods.

        Raises:
            InputError: the gradient is not finite; nothing is updated.
        """
        self._install()
        evaluation = self.rollout.run(self.initial, on_step)
        record = self._record(evaluation.trajectory, evaluation.value)
        moved = self.freedom.pose_rate is not None
        gradient = self.rollout.gradient(evaluation, moved, on_step=on_step)
        self._update(gradient, record.iteration)
        self.history.append(record)
        return record

    def measure(self) -> IterationRecord:
        """Drive with the present parameters, so that the last update counts too."""
        self._install()
        rollout = self.rollout
        drive = simulate(rollout.loop, self.initial, rollout.horizon)
        value, _ = Cost(rollout.objective, rollout.reduction).of(drive)
        return self._record(drive, value)

    def restore_best(self) -> None:
        """Give the objects the parameters of the iteration with the least objective."""
        self.sensor.set_textures(self.best)
        if self.freedom.pose_rate is not None:
            self.sensor.set_offsets(self.best_offsets)

    def _update(self, gradient: Gradient, iteration: int) -> None:
        values = {str(i): value for i, value in enumerate(gradient.textures)}
        if gradient.offsets is not None:
            values[OFFSETS] = _tensor(gradient.offsets * self.freedom.mask)
        values = {key: values[key] for key in self.optimiser}
        for key, value in values.items():
            if not np.isfinite(value.numpy()).all():
                what = "the poses" if key == OFFSETS else f"object {key}"
                raise InputError(
                    f"attack iteration {iteration}: the gradient of {what} is not "
                    "finite; check policy and field for NaN"
                )
        for key, value in values.items():
            dr.set_grad(self.optimiser[key], value)
        self.optimiser.step()
        if OFFSETS in values:
            moved = np.array(dr.detach(self.optimiser[OFFSETS]), np.float64)
            self.optimiser[OFFSETS] = _tensor(self.freedom.project(moved))

    def _install(self) -> None:
        """Give the sensor the optimiser's parameters."""
        if self.freedom.texture_rate is not None:
            keys = map(str, range(len(self.best)))
            self.sensor.set_textures([dr.detach(self.optimiser[key]) for key in keys])
        if self.freedom.pose_rate is not None:
            offsets = dr.detach(self.optimiser[OFFSETS])
            self.sensor.set_offsets(np.array(offsets, np.float64))

    def _textures(self) -> list[np.ndarray]:
        return [texture.numpy().copy() for texture in self.sensor.textures()]

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays."""
        rows = [list(asdict(record).values()) for record in self.history]
        result: dict[str, np.ndarray] = {
            "history": np.array(rows, np.float64).reshape(-1, 4),
            "best_mean_m": np.array([self.best_mean_m]),
            "best_objective": np.array([self.best_objective]),
            "best_offsets": self.best_offsets,
        }
        result |= {f"best.{i}": best for i, best in enumerate(self.best)}
        for key in self.optimiser:
            value, _, _, (count, first, second, _) = self.optimiser.state[key]
            result[f"texture.{key}"] = value.numpy().copy()
            result[f"count.{key}"] = np.array([_scalar(count)], np.int64)
            if first is not None:
                result[f"first.{key}"] = _numpy(first, value.shape)
                result[f"second.{key}"] = _numpy(second, value.shape)
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
        self.best_objective = float(tensors["best_objective"][0])
        self.best_offsets = np.array(tensors["best_offsets"])
        self.best = [np.array(tensors[f"best.{i}"]) for i in range(len(self.best))]
        for key in list(self.optimiser):
            self.optimiser[key] = mi.TensorXf(np.array(tensors[f"texture.{key}"]))
            value, promoted, rate, extra = self.optimiser.state[key]
            if f"first.{key}" in tensors:
                count = type(extra[0])([int(tensors[f"count.{key}"][0])])
                first = _like(extra[1], value, tensors[f"first.{key}"])
                second = _like(extra[2], value, tensors[f"second.{key}"])
                extra = (count, first, second, extra[3])
            self.optimiser.state[key] = (value, promoted, rate, extra)

    def _record(self, drive: Trajectory, value: float) -> IterationRecord:
        """Judge a drive; keep the present parameters if they are the best."""
        states = drive.states_numpy()[:, 1:]
        error = self.route.cross_track_numpy(states.reshape(-1, states.shape[2]))
        error = np.abs(error)
        mean = float(error.mean())
        if value < self.best_objective:
            self.best_objective, self.best_mean_m = value, mean
            self.best = self._textures()
            if self.freedom.pose_rate is not None:
                self.best_offsets = self.sensor.offsets()
        return IterationRecord(self.iteration, value, mean, float(error.max()))


def _tensor(value: np.ndarray) -> Any:
    return mi.TensorXf(np.ascontiguousarray(value, np.float32))


def _scalar(value: Any) -> int:
    return int(np.array(value).ravel()[0])


def _numpy(value: Any, shape: Any) -> np.ndarray:
    return np.array(value, np.float32).reshape(shape).copy()


def _like(sample: Any, value: Any, array: np.ndarray) -> Any:
    kind = type(sample) if sample is not None else type(value)
    if dr.is_tensor_v(kind):
        return kind(np.array(array, np.float32))
    return kind(np.array(array, np.float32).ravel())
