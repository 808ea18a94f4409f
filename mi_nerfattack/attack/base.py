"""What all attacks on a surrogate have in common, and what they may change."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from mi_nerfattack.attack.texture.colours import AbstractColouring, Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.posed import move_all, offsets_of
from mi_nerfattack.rollout.function import Evaluation, Rollout
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor
from mi_nerfattack.rollout.sweep import Gradient
from mi_nerfattack.vehicle.route.route import Route

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class Freedom:
    """Parameters of an attack and their learning rates.

    Attributes:
        texture_rate: Adam's, in colours (sRGB in 0 to 1); None leaves textures alone.
        colouring: makes what is stepped in, of each object's field.
        pose_rate: Adam's, in metres and radians; None leaves poses alone.
        axes: world axes, of `AXES`, along and about which objects may move.
        limit_m: largest shift along an axis; offsets are projected onto it after each
            update.
        limit_rad: largest component of the rotation vector of an object, radians;
            projected in the same way.

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
    rows = [posed.offset_gradient(gradient.parameters[key]) for posed, key in pairs]
    return np.array(rows).reshape(-1, 6)


@dataclass(frozen=True, slots=True)
class IterationRecord:
    """What one iteration gave, measured before its update.

    Attributes:
        iteration: from 0.
        objective: the cost that is minimised, reduced over the poses.
        cross_track_mean_m: mean |e| over steps and poses, metres.
        cross_track_max_m: largest |e|, metres.
        costs: of each pose, before their reduction; of a search, none.
    """

    iteration: int
    objective: float
    cross_track_mean_m: float
    cross_track_max_m: float
    costs: tuple[float, ...] = ()


class AbstractAttack(ABC):
    """Minimises a cost of the closed loop, iteration by iteration.

    Everything that is needed to go on is in :meth:`tensors`.

    Args:
        rollout: the loop, its objective and its adjoint.
        route: the lane centre, for the record.
        initial: (m, n) initial states.
        freedom: what may change.
        sensor: of the loop.

    Attributes:
        sweeps: of an iteration through the horizon, there and back.
        history: a record an iteration.
        best_objective: least so far.
        best_mean_m: mean |e| of the same iteration, metres.
        best_offsets: (k, 6) object offsets of the same.
        is_consistent: False while an update is half done, when the state must not be
            kept.
        one_level: whether objects are marched as one level while they are optimised.
    """

    sweeps: ClassVar[int]
    one_level: bool = False

    def __init__(
        self,
        rollout: Rollout,
        route: Route,
        initial: Any,
        freedom: Freedom,
        sensor: AbstractDifferentiableSensor,
    ) -> None:
        self.rollout = rollout
        self.route = route
        self.initial = initial
        self.freedom = freedom
        self.sensor = sensor
        self.history: list[IterationRecord] = []
        self.best_objective: float = np.inf
        self.best_mean_m: float = 0.0
        self.best_offsets: np.ndarray = offsets_of(sensor.objects)
        self.is_consistent = True

    @property
    def iteration(self) -> int:
        """Number of finished iterations."""
        return len(self.history)

    @property
    @abstractmethod
    def is_over(self) -> bool:
        """Whether to stop here."""

    @property
    @abstractmethod
    def has_converged(self) -> bool:
        """Whether there was nothing more to gain."""

    @property
    def _objectives(self) -> list[float]:
        return [record.objective for record in self.history]

    @abstractmethod
    def step(self, on_step: OnStep | None = None) -> IterationRecord:
        """Do one iteration.

        Args:
            on_step: called after each of the `sweeps` x horizon control periods.

        Raises:
            InputError: objective or gradient is not finite; nothing is updated.
        """

    @property
    @abstractmethod
    def best(self) -> list[np.ndarray]:
        """Textures (n_vertices, 3) of the iteration with the least objective."""

    @abstractmethod
    def curve(self, backward_multiple: float) -> np.ndarray:
        """Return the best objective so far and its cost, one row per measurement.

        Args:
            backward_multiple: cost of a backward pass, in drives.

        Returns:
            (n, 3): see :func:`best_so_far`.
        """

    def rows(self) -> list[dict[str, Any]]:
        """Return the history as ``attack.json`` has it, once finished."""
        return [asdict(record) for record in self.history]

    @property
    def least_gain(self) -> dict[str, Any] | None:
        """Five iterations in a row that gave the least of the predicted gain.

        Once finished. Of iterations that add up to a predicted fall of the objective.

        Returns:
            the index of the `first`, the gain that the gradient `predicted`, and the
            real `gain`. None without a gradient, and where there are no such five.
        """
        return None

    @property
    def without_gradient(self) -> list[int]:
        """Objects that the objective did not depend on, in all iterations.

        By its gradient; none for an attack that takes no gradient, and before the
        first iteration.
        """
        return []

    @property
    def judged_objective(self) -> float:
        """Least objective, measured as for random textures; once finished."""
        return self.best_objective

    @property
    def best_is_judged(self) -> bool:
        """Whether the best parameters were measured by this attack's objective."""
        return not self.history or np.isfinite(self.best_objective)

    def judge_best(self, on_step: OnStep | None = None) -> None:
        """Measure the best parameters again; costs one drive.

        Args:
            on_step: called after each control period.
        """
        raise NotImplementedError(f"{type(self).__name__}: every iteration is judged")

    def finish(self) -> None:
        """Judge what no iteration has judged yet, and install the best."""
        self.restore_best()

    def restore_best(self) -> None:
        """Give the objects the parameters of the iteration with the least objective."""
        self.sensor.set_textures(self.best)
        move_all(self.sensor.objects, self.best_offsets)

    def measure_through(self, sensor: AbstractDifferentiableSensor) -> float:
        """Drive in a closed loop through another sensor, with the present textures.

        Args:
            sensor: that shows the same objects; it draws what the attack's does.

        Returns:
            mean distance from the lane centre, metres.
        """
        loop = self.rollout.loop
        loop = replace(loop, sensor=sensor.drawing_as(loop.sensor))
        closed = replace(self.rollout, loop=loop, camera_path=None)
        evaluation = closed.measure(self.initial)
        return float(distances(self.route, evaluation).mean())

    @abstractmethod
    def tensors(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays."""

    @abstractmethod
    def load_tensors(self, tensors: dict[str, np.ndarray]) -> None:
        """Take over a state written by :meth:`tensors`, and install its best.

        Raises:
            InputError: the entries do not fit each other, or what is allowed.
            KeyError: an entry is missing.
        """

    def go_on_from(self, tensors: dict[str, np.ndarray]) -> None:
        """Take over the state of an attack that differed from this one.

        By default, nothing of it counts.

        Args:
            tensors: its :meth:`tensors`.

        Raises:
            InputError: nothing of it counts here.
            KeyError: an entry is missing.
        """
        raise InputError(
            f"{type(self).__name__}: what it was told is of another scenario, and "
            "counts no longer; start a new run folder"
        )


def history_tensors(history: Sequence[IterationRecord]) -> dict[str, np.ndarray]:
    """Return n records as arrays.

    Returns:
        ``history`` (n, 4), the numbers of :class:`IterationRecord`; ``costs``, those of
        all iterations end to end; ``cost_counts`` (n,), how many each has.
    """
    rows = [astuple(record)[:-1] for record in history]
    costs = [cost for record in history for cost in record.costs]
    return {
        "history": np.array(rows, np.float64).reshape(-1, 4),
        "costs": np.array(costs, np.float64),
        "cost_counts": np.array([len(record.costs) for record in history], np.int64),
    }


def read_history(tensors: dict[str, np.ndarray]) -> list[IterationRecord]:
    """Return the records that :func:`history_tensors` made arrays of.

    Raises:
        InputError: the arrays do not fit each other.
        KeyError: an array is missing.
    """
    rows, counts, costs = (tensors[k] for k in ("history", "cost_counts", "costs"))
    if counts.shape != rows.shape[:1] or counts.sum() != len(costs):
        raise InputError(f"{len(rows)} iterations, costs of {len(counts)}")
    # The costs of all iterations are end to end: cut them where each iteration ends.
    segments = np.split(costs, np.cumsum(counts)[:-1])
    return [
        IterationRecord(int(iteration), *numbers, costs=tuple(part.tolist()))
        for (iteration, *numbers), part in zip(rows.tolist(), segments, strict=False)
    ]


def best_so_far(
    frames: Sequence[float], objectives: Sequence[float], means_m: Sequence[float]
) -> np.ndarray:
    """Return what a search had found after each of its measurements.

    Args:
        frames: rendered until the end of each.
        objectives: of each, minimised.
        means_m: mean |e| of each, metres.

    Returns:
        (n, 3): frames until then, least objective, its mean |e| in metres.
    """
    values = np.array(objectives, np.float64)
    # The index of the best so far is that of the last measurement which improved on
    # all measurements before it; the first of equal measurements stays the best.
    before = np.minimum.accumulate(np.append(np.inf, values[:-1]))[: len(values)]
    best = np.maximum.accumulate(np.where(values < before, np.arange(len(values)), 0))
    return np.column_stack([frames, values[best], np.array(means_m)[best]])


def distances(route: Route, evaluation: Evaluation) -> np.ndarray:
    """Return the distances from the lane centre, metres, of all states of drives."""
    states = evaluation.trajectory.states_numpy()[:, 1:]
    return np.abs(route.cross_track_numpy(states.reshape(-1, states.shape[2])))
