"""Searches by drives in the surrogate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.attack.base import (
    AbstractAttack,
    Freedom,
    IterationRecord,
    distances,
)
from mi_nerfattack.attack.black_box.search import (
    AbstractSearch,
    BlackBoxAttack,
    Judged,
    Textures,
)
from mi_nerfattack.attack.plan import has_settled
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop, OnStep
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True, eq=False)
class SurrogateJudge:
    """Judges as an attack by gradient does: its objective, from the poses it starts at.

    The policy needs no derivatives.

    Attributes:
        rollout: of the attack.
        route: the lane centre.
        initial: (m, n) that it starts from.
    """

    rollout: Rollout
    route: Route
    initial: Any

    def __call__(self, textures: Textures, on_step: OnStep | None = None) -> Judged:
        """Drive once; see `Judge`.

        Raises:
            InputError: the sensor shows no fields.
        """
        sensor = textured(self.rollout.loop)
        sensor.set_textures(list(textures))
        # The budget counts the frames that this drive makes the sensor render
        before = sensor.renders
        evaluation = self.rollout.measure(self.initial, on_step)
        error = distances(self.route, evaluation)
        frames = sensor.renders - before
        return Judged(evaluation.value, float(error.mean()), float(error.max()), frames)


class SurrogateSearch(AbstractAttack):
    """A search as an attack on a surrogate, which goes on where it was stopped.

    An iteration is one judgement.

    Args:
        search: makes the proposals; new.
        rollout: the loop and its objective.
        route: the lane centre.
        initial: (m, n) initial states of each judgement.
        freedom: what may change.
        frames: budget.

    Raises:
        InputError: the sensor shows no fields.
    """

    sweeps = 1

    def __init__(
        self,
        search: AbstractSearch,
        rollout: Rollout,
        route: Route,
        initial: Any,
        freedom: Freedom,
        frames: int,
    ) -> None:
        super().__init__(rollout, route, initial, freedom, textured(rollout.loop))
        self._original = [t.numpy().copy() for t in self.sensor.textures()]
        judge = SurrogateJudge(rollout, route, initial)
        self._attack = BlackBoxAttack(search, judge, frames)

    @property
    def is_over(self) -> bool:
        """See ``AbstractAttack.is_over``."""
        return self._attack.is_over

    @property
    def has_converged(self) -> bool:
        """See ``AbstractAttack.has_converged``."""
        return has_settled(self._objectives)

    @property
    def best(self) -> list[np.ndarray]:
        """See ``AbstractAttack.best``."""
        textures = self._attack.best
        return self._original if textures is None else textures

    def step(self, on_step: OnStep | None = None) -> IterationRecord:
        """See ``AbstractAttack.step``."""
        self._add(self._attack.step(on_step))
        return self.history[-1]

    def _add(self, judged: Judged) -> None:
        objective, mean = judged.objective, judged.cross_track_mean_m
        if objective < self.best_objective:
            self.best_objective, self.best_mean_m = objective, mean
        largest = judged.cross_track_max_m
        self.history.append(
            IterationRecord(self.iteration, objective, mean, cross_track_max_m=largest)
        )

    def curve(self, backward_multiple: float) -> np.ndarray:
        """See ``AbstractAttack.curve``; this attack has no backward pass."""
        del backward_multiple
        return self._attack.curve()

    def tensors(self) -> dict[str, np.ndarray]:
        """See ``AbstractAttack.tensors``."""
        return self._attack.tensors()

    def load_tensors(self, tensors: dict[str, np.ndarray]) -> None:
        """See ``AbstractAttack.load_tensors``."""
        # The search replays its history; the records follow from what it judged
        self._attack.load_tensors(tensors)
        for judged in self._attack.history:
            self._add(judged)
        self.restore_best()


def textured(loop: ClosedLoop) -> SceneSensor:
    """Return a loop's sensor, whose objects have textures.

    Raises:
        InputError: it shows no fields.
    """
    if not isinstance(loop.sensor, SceneSensor):
        raise InputError(f"{type(loop.sensor).__name__}: has no textures to change")
    return loop.sensor


@dataclass(frozen=True, eq=False)
class Task:
    """What an attack is made for.

    Attributes:
        rollout: the loop, its objective and its adjoint.
        route: the lane centre.
        initial: (m, n) that it starts from.
        freedom: what may change.
        seed: of the scenario.
    """

    rollout: Rollout
    route: Route
    initial: Any
    freedom: Freedom
    seed: int

    @property
    def fields(self) -> Sequence[GridField]:
        """Of the objects."""
        return textured(self.rollout.loop).fields

    @property
    def colourings(self) -> list[Colours]:
        """What may change of the texture of each object."""
        colourings = [self.freedom.colouring(field) for field in self.fields]
        # All of them are Colours.
        return [item for item in colourings if isinstance(item, Colours)]

    @property
    def frames(self) -> int:
        """Frames of the drives of one judgement."""
        return self.rollout.horizon * len(self.initial[0])
