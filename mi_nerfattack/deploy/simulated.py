"""Environments made of a simulated vehicle and a rendered view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.vehicle import AbstractVehicle, checked_pose
from mi_nerfattack.deploy.views.base import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount, mount_matrix
from mi_nerfattack.vehicle.route.route import Route


class SimulatedEnvironment(AbstractEnvironment):
    """Any vehicle in any view: the surrogate, `mitsuba` and `mujoco` are such pairs.

    Args:
        name: of the pair.
        vehicle: moves.
        view: renders.
        mount: the camera's place on the vehicle.
        period: seconds that the vehicle holds a control.
    """

    def __init__(
        self,
        name: str,
        vehicle: AbstractVehicle,
        view: AbstractView,
        mount: CameraMount,
        period: float,
    ) -> None:
        self.name, self.vehicle, self.view = name, vehicle, view
        self.camera, self.period = view.camera, period
        self.max_control = vehicle.max_control
        self.control_unit = vehicle.control_unit
        self._mount = mount_matrix(np.zeros((1, 3)), mount)[0]
        self._seed, self._steps = 0, -1

    def reset(
        self, route: Route, pose: np.ndarray | None = None, seed: int = 0
    ) -> CameraFrame:
        """Put the vehicle on the route's start, or elsewhere."""
        start = checked_pose(route.pose_at(0.0) if pose is None else pose)
        if seed < 0:
            raise InputError(f"seed: {seed}; at least 0")
        self.vehicle.reset(start, route.speed_ms, seed)
        self._seed, self._steps = seed, 0
        return self._observe()

    def step(self, control: float) -> CameraFrame:
        """Drive one period and render."""
        if self._steps < 0:
            raise InputError(f"environment {self.name!r}: step comes after reset")
        self.vehicle.advance(float(control))
        self._steps += 1
        return self._observe()

    @property
    def state(self) -> np.ndarray:
        """State (m,) of the vehicle."""
        return self.vehicle.state

    def show(self, objects: Sequence[Any]) -> None:
        """Show fields, in the view's way."""
        self.view.show(objects)

    def close(self) -> None:
        """Close the view."""
        self.view.close()

    def _observe(self) -> CameraFrame:
        pose = self.vehicle.body_to_world @ self._mount
        # 32 bits each: a seed of its own for every frame of every drive
        sequence = np.random.SeedSequence([self._seed, self._steps])
        return self.view.render(pose, int(sequence.generate_state(1)[0]))
