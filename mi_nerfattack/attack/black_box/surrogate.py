"""Judgement of textures by drives in the surrogate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.attack.black_box.search import Judged, Textures
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.field_sensor import FieldSensor
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import OnStep
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
        sensor = self.rollout.loop.sensor
        if not isinstance(sensor, FieldSensor):
            raise InputError(f"{type(sensor).__name__}: has no textures to change")
        sensor.set_textures(list(textures))
        before = sensor.renders
        seen = self.rollout.measure(self.initial, on_step)
        states = seen.trajectory.states_numpy()[:, 1:]
        rows = states.reshape(-1, states.shape[2])
        error = np.abs(self.route.cross_track_numpy(rows))
        frames = sensor.renders - before
        return Judged(seen.value, float(error.mean()), float(error.max()), frames)
