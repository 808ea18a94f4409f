"""Attack by gradient: Adam on textures and poses, through the closed loop."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from mi_nerfattack.attack.base import (
    AbstractAttack,
    Freedom,
    IterationRecord,
    best_so_far,
    distances,
    history_tensors,
    offset_gradients,
    read_history,
)
from mi_nerfattack.attack.plan import Plan, Schedule
from mi_nerfattack.attack.texture.colours import AbstractColouring, Colours
from mi_nerfattack.backend.arrays import adam_tensors, load_adam
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.posed import move_all, offsets_of
from mi_nerfattack.rollout.function import Evaluation, Rollout
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.rollout.sweep import Gradient, differentiable
from mi_nerfattack.vehicle.route.route import Route

OFFSETS = "offsets"

#: Parameters of the objects' textures, (n, 3) each, by the optimiser's key.
Parameters = dict[str, np.ndarray]


class GradientAttack(AbstractAttack):
    """Minimise a cost of the closed loop by its objects' textures and poses.

    Holds the parameters, Adam's moments, the history and the best parameters so far;
    everything is in :meth:`tensors`, so that an interrupted attack can go on.

    Cost of an iteration: one drive forward and one backward; see the adjoint.

    Args:
        rollout: the loop, its objective and its adjoint.
        route: the lane centre, for the record.
        initial: (m, n) initial states.
        freedom: what may change.
        plan: what each iteration does; one start and constant rates by default.
        one_level: march objects as one level while they are optimised, see
            `fields.one_level.OneLevel`.

    Attributes:
        predicted_gains: by how much the objective was to fall in the update after each
            iteration, by the gradient.

    Raises:
        InputError: `one_level`, with a colouring that steps in other parameters than
            the colours of a level.
    """

    sweeps = 2

    def __init__(
        self,
        rollout: Rollout,
        route: Route,
        initial: Any,
        freedom: Freedom | None = None,
        plan: Plan | None = None,
        one_level: bool = False,
    ) -> None:
        freedom = freedom or Freedom()
        super().__init__(rollout, route, initial, freedom, differentiable(rollout.loop))
        self.plan: Plan = plan or Plan(Schedule(sys.maxsize))
        self.one_level = one_level
        self.optimiser: Adam = Adam(lr=1.0)
        self.predicted_gains: list[float] = []
        self._colourings: dict[str, AbstractColouring] = {}
        self._offsets_before = self.best_offsets
        self._depended = np.zeros(len(self.sensor.objects), bool)
        self._best: Parameters = {}  # of the iteration with the least objective
        self._last: IterationRecord | None = None  # what the last update gave
        self._exact: float | None = None  # objective of the best, with all levels
        if self.freedom.texture_rate is not None:
            for i, field in enumerate(self.sensor.fields):
                colouring = self.freedom.colouring(field)
                if one_level and not isinstance(colouring, Colours):
                    raise InputError(
                        f"one_level: {type(colouring).__name__} may step in all levels "
                        "of a texture; leave one_level out, or step in Colours"
                    )
                self._colourings[str(i)] = colouring
                self._best[str(i)] = colouring.start
                self.optimiser[str(i)] = _tensor(colouring.start)
        if self.freedom.pose_rate is not None:
            self.optimiser[OFFSETS] = _tensor(self.best_offsets)

    @property
    def is_over(self) -> bool:
        """Whether the plan ends here."""
        return self.plan.is_over(self._objectives)

    @property
    def has_converged(self) -> bool:
        """Whether there was nothing more to gain at the full rates."""
        return self.plan.has_converged(self._objectives)

    def step(self, on_step: OnStep | None = None) -> IterationRecord:
        """Do one iteration.

        Args:
            on_step: called after each of the 2 x horizon control periods.

        Raises:
            InputError: the gradient is not finite; nothing is updated.
        """
        self._begin()
        moved = self.sensor.pose_keys if self.freedom.pose_rate is not None else ()
        with self._as_one_level():
            self._install()
            evaluation = self.rollout.run(self.initial, on_step)  # forward: the drive
            record = self._record(evaluation)
            rollout = self.plan.followed(self.rollout, self._objectives)
            gradient = rollout.gradient(evaluation, moved, on_step=on_step)  # A.9, A.11
        values = self._values(gradient)
        self.is_consistent = False  # an interrupt would leave half an update
        gain = self._update(values)  # Adam's step, then the projection
        self.history.append(record)
        self.predicted_gains.append(gain)
        self.is_consistent = True
        return record

    def _begin(self) -> None:
        """Start from other parameters, or with new moments, where the plan says so."""
        if self.plan.starts_over(self.iteration):
            values = self._start(self.plan.try_index(self.iteration))
        elif self.plan.resets_moments(self._objectives):
            values = {key: self._value(key) for key in self.optimiser}
        else:
            return
        self.optimiser = Adam(lr=1.0)
        for key, value in values.items():
            self.optimiser[key] = _tensor(value)

    def _start(self, number: int | None) -> Parameters:
        """Return what a try starts from; None for the best of all tries."""
        opening = self.plan.opening
        if number is None or opening is None:
            values, offsets = dict(self._best), self.best_offsets  # after the opening
        else:
            values = {key: c.start for key, c in self._colourings.items()}  # a new try
            if (looks := opening.textures(number)) is not None:
                for key, c in self._colourings.items():
                    values[key] = c.near(looks[int(key)])
            drawn = opening.offsets(number)
            offsets = self._offsets_before if drawn is None else drawn
        return values | ({OFFSETS: offsets} if OFFSETS in self.optimiser else {})

    def finish(self) -> None:
        """See ``AbstractAttack.finish``."""
        self._last = self.measure()
        self.restore_best()
        if self.one_level:
            exact = self.rollout.measure(self.initial).value
            self._exact = exact + self._penalty(self._best)

    @property
    def judged_objective(self) -> float:
        """See ``AbstractAttack.judged_objective``."""
        return self.best_objective if self._exact is None else self._exact

    def curve(self, backward_multiple: float) -> np.ndarray:
        """See ``AbstractAttack.curve``; once finished, the last update counts too.

        A measurement is a drive; an update with its backward pass follows it.
        """
        records = [*self.history, *([self._last] if self._last else [])]
        drive = self.rollout.frames * len(self.initial[0])
        frames = [
            drive * (1 + k * (1 + backward_multiple)) for k in range(len(records))
        ]
        means = [record.cross_track_mean_m for record in records]
        return best_so_far(frames, [record.objective for record in records], means)

    def measure(self) -> IterationRecord:
        """Drive with the present parameters, so that the last update counts too."""
        with self._as_one_level():
            self._install()
            return self._record(self.rollout.measure(self.initial))

    @property
    def best(self) -> list[np.ndarray]:
        """Textures (n_vertices, 3) of the iteration with the least objective."""
        if not self._colourings:
            return [texture.numpy().copy() for texture in self.sensor.textures()]
        return self._textures(self._best)

    def rows(self) -> list[dict[str, Any]]:
        """See ``AbstractAttack.rows``; with the predicted and the real gain.

        Without those of the opening, whose tries end before they are judged.
        """
        rows = super().rows()
        gains = zip(self.predicted_gains, self._gains.tolist(), strict=True)
        for k, (row, pair) in enumerate(zip(rows, gains, strict=True)):
            gain_pair = pair if k >= self.plan.tried else (None, None)
            row["predicted_gain"], row["gain"] = gain_pair
        return rows

    @property
    def least_gain(self) -> dict[str, Any] | None:
        """See ``AbstractAttack.least_gain``, of iterations at the full rates.

        Of an attack that converged, their last fifth, which was to gain nothing, does
        not count.
        """
        predicted = self.predicted_gains
        return self.plan.least_gain(self._objectives, predicted, self._gains)

    @property
    def _gains(self) -> np.ndarray:
        """By how much the objective fell after each iteration, (n,), once finished."""
        last = [self._last.objective] if self._last else self._objectives[-1:]
        return -np.diff([*self._objectives, *last])

    @property
    def without_gradient(self) -> list[int]:
        """See ``AbstractAttack.without_gradient``."""
        return np.flatnonzero(~self._depended).tolist() if self.history else []

    def judge_best(self, on_step: OnStep | None = None) -> None:
        """See `AbstractAttack.judge_best`."""
        self.restore_best()
        self.best_objective = np.inf
        with self._as_one_level():
            self._record(self.rollout.measure(self.initial, on_step), self._best)

    @contextmanager
    def _as_one_level(self) -> Iterator[None]:
        """March the objects as one level, if asked to."""
        with ExitStack() as stack:
            for i, field in enumerate(self.sensor.fields if self.one_level else ()):
                colouring = self._colourings.get(str(i))
                stepped = isinstance(colouring, Colours)
                level = colouring.level if stepped else field.levels()[-1]
                stack.enter_context(field.one_level(level))
            yield

    def _values(self, gradient: Gradient) -> Parameters:
        """Return the gradient by the optimiser's keys, checked."""
        colours = self._colours()
        values = {}
        for key, colouring in self._colourings.items():
            by_texture, row = gradient.textures[int(key)].numpy(), int(key)
            values[key] = colouring.gradient(colours[key], by_texture)
            if not self._depended[row]:  # a penalty does not count
                alone = colouring.gradient(colours[key], np.zeros_like(by_texture))
                self._depended[row] = (values[key] != alone).any()
        if self.freedom.pose_rate is not None:
            by_offsets = offset_gradients(self.sensor, gradient)
            values[OFFSETS] = by_offsets * self.freedom.mask
            self._depended |= values[OFFSETS].any(axis=1)
        values = {key: values[key] for key in self.optimiser}
        for key, value in values.items():
            if not np.isfinite(value).all():
                what = "the poses" if key == OFFSETS else f"object {key}"
                raise InputError(
                    f"attack iteration {self.iteration}: the gradient of {what} is not "
                    "finite; check policy and field for NaN"
                )
        return values

    def _update(self, gradients: Parameters) -> float:
        """Step; return the gain that the gradients predict."""
        before = {key: self._value(key) for key in gradients}  # to predict the gain
        scale = self.plan.gradient_scale(list(gradients.values()))
        values = {
            key: self._colourings[key].smoothed(value) if key != OFFSETS else value
            for key, value in gradients.items()
        }
        share = self.plan.rate(self._objectives)  # of the full learning rates
        full = self.freedom.texture_rate or 0.0, self.freedom.pose_rate or 0.0
        rates = {key: share * full[key == OFFSETS] for key in values}
        self.optimiser.set_learning_rate(rates)
        for key, value in values.items():
            dr.set_grad(self.optimiser[key], _tensor(value / scale))
        self.optimiser.step()
        # Back to the colours and poses that are allowed
        for key, value in self._colours().items():
            self.optimiser[key] = _tensor(self._colourings[key].project(value))
        if OFFSETS in values:
            moved = np.array(dr.detach(self.optimiser[OFFSETS]), np.float64)
            self.optimiser[OFFSETS] = _tensor(self.freedom.project(moved))
        steps = {key: self._value(key) - old for key, old in before.items()}
        return -sum(float((gradients[key] * step).sum()) for key, step in steps.items())

    def _value(self, key: str) -> np.ndarray:
        """Return what the optimiser has, copied."""
        return dr.detach(self.optimiser[key]).numpy().copy()

    def _install(self) -> None:
        """Give the sensor the optimiser's parameters."""
        if self._colourings:
            textures = self._textures(self._colours())
            self.sensor.set_textures([_tensor(texture) for texture in textures])
        if self.freedom.pose_rate is not None:
            move_all(self.sensor.objects, self._value(OFFSETS).astype(np.float64))

    def _colours(self) -> Parameters:
        """Return what is stepped in, by the optimiser's key."""
        return {key: self._value(key) for key in self._colourings}

    def _penalty(self, colours: Parameters) -> float:
        return sum(c.penalty(colours[key]) for key, c in self._colourings.items())

    def _textures(self, colours: Parameters) -> list[np.ndarray]:
        return [c.texture(colours[key]) for key, c in self._colourings.items()]

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays."""
        return {
            **history_tensors(self.history),
            "predicted_gains": np.array(self.predicted_gains, np.float64),
            "depended": self._depended.astype(np.uint8),
            **adam_tensors(self.optimiser),
            **{f"best.{key}": best for key, best in self._best.items()},
            "best_mean_m": np.array([self.best_mean_m]),
            "best_objective": np.array([self.best_objective]),
            "best_offsets": self.best_offsets,
        }

    def load_tensors(self, tensors: dict[str, np.ndarray]) -> None:
        """See `AbstractAttack.load_tensors`."""
        self._read_history(tensors)
        self.best_mean_m = float(tensors["best_mean_m"][0])
        self.best_objective = float(tensors["best_objective"][0])
        self.best_offsets = np.array(tensors["best_offsets"])
        self._best = {key: np.array(tensors[f"best.{key}"]) for key in self._best}
        for key, best in self._best.items():
            allowed = np.allclose(self._colourings[key].project(best), best, 0, 1e-3)
            if not (allowed and np.isfinite(best).all()):
                raise InputError(f"best.{key}: colours that the attack may not have")
        load_adam(self.optimiser, tensors)
        self.restore_best()

    def go_on_from(self, tensors: dict[str, np.ndarray]) -> None:
        """See `AbstractAttack.go_on_from`.

        Parameters that the other did not change start as they are, those that this one
        may not change stay as they are. The best ones are not judged yet: call
        :meth:`judge_best` before the next iteration.
        """
        self._read_history(tensors)
        self.best_objective = np.inf
        for key in [key for key in self.optimiser if f"value.{key}" in tensors]:
            name, moved = f"value.{key}", key == OFFSETS
            project = (self.freedom if moved else self._colourings[key]).project
            allowed = {**tensors, name: project(tensors[name])}  # within the new limits
            load_adam(self.optimiser, allowed, [key])
            if moved:
                self.best_offsets = project(tensors["best_offsets"])
            else:
                self._best[key] = project(tensors[f"best.{key}"])

    def _read_history(self, tensors: dict[str, np.ndarray]) -> None:
        history, gains = read_history(tensors), tensors["predicted_gains"].tolist()
        if len(gains) != len(history):
            raise InputError(f"{len(history)} iterations, {len(gains)} predicted gains")
        self.history, self.predicted_gains = history, gains
        self._depended = np.array(tensors["depended"], bool)

    def _record(
        self, evaluation: Evaluation, colours: Parameters | None = None
    ) -> IterationRecord:
        """Judge a drive; keep its parameters if they are the best.

        Args:
            evaluation: the drive.
            colours: that it was driven with; the present ones by default.
        """
        colours = self._colours() if colours is None else colours
        error = distances(self.route, evaluation)
        mean, value = float(error.mean()), evaluation.value
        value += self._penalty(colours)
        if value < self.best_objective:
            self._best = colours
            self.best_offsets = offsets_of(self.sensor.objects)
            self.best_objective, self.best_mean_m = value, mean
        costs = tuple(map(float, evaluation.costs))
        return IterationRecord(self.iteration, value, mean, float(error.max()), costs)


def _tensor(value: np.ndarray) -> Any:
    return mi.TensorXf(np.ascontiguousarray(value, np.float32))
