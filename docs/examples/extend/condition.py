"""Play in the steering: a control has no effect until it has changed by so much."""

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.stress.timing import AbstractAround
from mi_nerfattack.deploy.vehicle import Controls
from mi_nerfattack.errors import InputError


class Play(AbstractAround):
    def __init__(self, inside: AbstractEnvironment, width: float) -> None:
        super().__init__(inside)
        if not width >= 0:
            raise InputError(f"play: {width!r}; at least 0, in the control's unit")
        self.width, self.held = width, np.zeros(1)

    def begin(self, frame: CameraFrame, seed: int) -> CameraFrame:
        self.held = np.zeros(len(self.control_names))
        return frame

    def step(self, control: Controls) -> CameraFrame:
        return self.inside.step(self._taken(control))

    def advance(self, control: Controls) -> None:
        self.inside.advance(self._taken(control))

    def _taken(self, control: Controls) -> np.ndarray:
        asked = np.atleast_1d(np.asarray(control, np.float64))
        self.held = np.clip(self.held, asked - self.width / 2, asked + self.width / 2)
        return self.held
