"""A kinematic car whose camera sees nothing."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.deploy import CameraFrame
from mi_nerfattack.deploy.kinematic import KinematicVehicle, Motion
from mi_nerfattack.deploy.simulated import SimulatedEnvironment
from mi_nerfattack.deploy.views.base import AbstractView
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.vehicle.dynamics import Dubins


class BlankView(AbstractView):
    """A view of nothing that notes with which seeds it was asked to render."""

    def __init__(self) -> None:
        self.camera, self.seeds = from_fov(4, 2, 90.0), []

    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        self.seeds.append(seed)
        depth = np.full((2, 4), np.inf, np.float32)
        return CameraFrame(np.zeros((2, 4, 3), np.uint8), depth, camera_to_world)

    def show(self, objects) -> None:
        pass

    def close(self) -> None:
        pass


def blank_environment(mount: CameraMount | None = None) -> SimulatedEnvironment:
    motion, mount = Motion(Dubins(max_heading_rate=1.5)), mount or CameraMount()
    vehicle = KinematicVehicle(motion, 0.1, 1.5)
    return SimulatedEnvironment("blank", vehicle, BlankView(), mount, 0.1)
