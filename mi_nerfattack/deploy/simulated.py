"""Environments made of a simulated vehicle and a rendered view."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import (
    AbstractEnvironment,
    CameraFrame,
    join_frames,
    policy_image,
)
from mi_nerfattack.deploy.vehicle import AbstractVehicle, Controls, checked_pose
from mi_nerfattack.deploy.views.paste import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.disturbance import disturbed
from mi_nerfattack.render.camera.intrinsics import Camera, camera_to_body
from mi_nerfattack.render.camera.rig import Rig, camera_seed
from mi_nerfattack.vehicle.route.route import Route


class AbstractSimulation(AbstractEnvironment):
    """A simulated vehicle, and what sees for it.

    Args:
        name: of the environment.
        vehicle: moves.
        rig: cameras.
        period: seconds that the vehicle holds a control.
    """

    def __init__(
        self, name: str, vehicle: AbstractVehicle, rig: Rig, period: float
    ) -> None:
        self.name: str = name
        self.vehicle: AbstractVehicle = vehicle
        self.rig = rig
        self.camera: Camera = rig.cameras[0]
        self.period: float = period
        self.max_control: float = vehicle.max_control
        self.control_unit: str = vehicle.control_unit
        self.more_controls = vehicle.more_controls
        self._seed, self._steps = 0, -1
        self.blur_px, self.noise_sd = 0.0, 0.0  # of the camera

    def reset(
        self, route: Route, pose: np.ndarray | None = None, seed: int = 0
    ) -> CameraFrame:
        """Put the vehicle on the route's start, or elsewhere."""
        start = checked_pose(route.pose_at(0.0) if pose is None else pose)
        if seed < 0:
            raise InputError(f"seed: {seed}; at least 0")
        self.vehicle.reset(start, route.speed_ms, seed)
        self._seed, self._steps = seed, 0
        return self._disturbed(self._observe())

    def step(self, control: Controls) -> CameraFrame:
        """Drive one period and render."""
        self.advance(control)
        return self._disturbed(self._observe())

    def advance(self, control: Controls) -> None:
        """Drive one period and render nothing; what changes the motion belongs here."""
        if self._steps < 0:
            raise InputError(f"environment {self.name!r}: step comes after reset")
        self.vehicle.advance(control)
        self._steps += 1

    @property
    def state(self) -> np.ndarray:
        """State (m,) of the vehicle."""
        return self.vehicle.state

    @property
    def speed(self) -> float:
        """Speed of the vehicle."""
        return self.vehicle.speed

    def _disturbed(self, frame: CameraFrame) -> CameraFrame:
        """Blur the image of a frame and add noise, in eight bits."""
        if not (self.blur_px or self.noise_sd):
            return frame
        image = policy_image(frame.image)
        exposure, blur = np.zeros((1, 3)), np.full(1, self.blur_px)
        observation = disturbed(
            image,
            exposures=exposure,
            blurs=blur,
            noise_sd=self.noise_sd,
            seed=self._seed,
            step=self._steps,
            layout=self.rig.layout,
        )
        image = np.round(255 * np.array(observation)[0]).astype(np.uint8)
        return replace(frame, image=image, linear=frame.light)

    @abstractmethod
    def _observe(self) -> CameraFrame:
        """Render what the vehicle sees, of seed `_seed` and step `_steps`."""


class SimulatedEnvironment(AbstractSimulation):
    """Any vehicle in any view: `mitsuba` and `mujoco` are such pairs.

    Args:
        name: of the pair.
        vehicle: moves.
        views: render, one for each camera.
        rig: the cameras.
        period: seconds that the vehicle holds a control.
    """

    def __init__(
        self,
        name: str,
        vehicle: AbstractVehicle,
        views: Sequence[AbstractView],
        rig: Rig,
        period: float,
    ) -> None:
        super().__init__(name, vehicle, rig, period)
        self.views = list(views)
        self._mounts = [camera_to_body(mount) for mount in rig.mounts]

    def show(self, objects: Sequence[Any]) -> None:
        """Show fields, in the views' way."""
        for view in self.views:
            view.show(objects)

    def close(self) -> None:
        """Close the views."""
        for view in self.views:
            view.close()

    def _observe(self) -> CameraFrame:
        # 32 bits each: a seed of its own for every frame of every drive
        sequence = np.random.SeedSequence([self._seed, self._steps])
        seed, body = int(sequence.generate_state(1)[0]), self.vehicle.body_to_world
        pairs = zip(self.views, self._mounts, strict=True)
        frames = [
            view.render(body @ mount, camera_seed(seed, index))
            for index, (view, mount) in enumerate(pairs)
        ]
        return join_frames(frames, self.rig.layout)
