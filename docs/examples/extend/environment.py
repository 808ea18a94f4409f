"""The scene as Mitsuba renders it, in fog."""

from dataclasses import replace

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.deploy.stress.timing import AbstractAround
from mi_nerfattack.deploy.vehicle import Controls
from mi_nerfattack.ranges import Positive

GREY = 190.0  # of the fog, sRGB


class Fog(AbstractAround):
    def __init__(self, inside: AbstractEnvironment, density: float) -> None:
        super().__init__(inside)
        self.name, self.density = "foggy", density

    def begin(self, frame: CameraFrame, seed: int) -> CameraFrame:
        return self._foggy(frame)

    def step(self, control: Controls) -> CameraFrame:
        return self._foggy(self.inside.step(control))

    def _foggy(self, frame: CameraFrame) -> CameraFrame:
        weight = np.exp(-self.density * frame.depth)[..., None]  # 0 where nothing is
        image = np.round(weight * frame.image + (1 - weight) * GREY).astype(np.uint8)
        return replace(frame, image=image, linear=None, split=None)


def make(
    place: Place, conditions: Conditions, density_per_m: Positive = 0.02
) -> AbstractEnvironment:
    return Fog(make_environment("mitsuba", place, conditions), density_per_m)
