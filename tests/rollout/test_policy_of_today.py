"""Gradients of a policy with two cameras and the speed in, and waypoints out.

A car with a speed state follows them. References are central differences of the loop.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.reference.derivatives import central_difference
from support.worlds import loops as toy

from mi_nerfattack.policy.action import Action, Trajectory
from mi_nerfattack.policy.base import Numbers
from mi_nerfattack.policy.inputs import Inputs, NoGoal
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.rollout.loop import CameraPath, ClosedLoop
from mi_nerfattack.vehicle.dynamics import to_state
from mi_nerfattack.vehicle.single_track import KinematicSingleTrack

pytestmark = pytest.mark.usefixtures("variant")

LEFT = CameraMount(1.0, 0.2, 8.0, left_m=0.5, yaw_deg=15.0)
LENSES = from_fov(toy.WIDTH, toy.HEIGHT, 70.0), from_fov(16, 12, 60.0)
RIG = Rig(("front", "left"), LENSES, (toy.MOUNT, LEFT))
TIMES = 0.3, 0.6, 0.9


class Waypoints(torch.nn.Module):
    """Bends a straight path by what the cameras see, the more the faster it is."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(5)
        self.weights = torch.nn.ParameterList(
            self._weight(camera.height, camera.width, generator) for camera in LENSES
        )

    def _weight(self, height: int, width: int, generator: torch.Generator):
        coarse = torch.randn(1, 3, 3, 4, generator=generator)
        smooth = torch.nn.functional.interpolate(coarse, (height, width))
        return torch.nn.Parameter(0.02 * smooth)

    def forward(self, left, front, speed):
        pairs = zip(self.weights, (front, left), strict=True)
        bend = torch.tanh(sum(((x - 0.4) * w).sum((1, 2, 3)) for w, x in pairs))
        way = speed * torch.tensor(TIMES)
        return torch.stack([way, 0.3 * bend[:, None] * way**2], 2)


def make_loop(jitter: int | None = 7) -> tuple[ClosedLoop, list]:
    one, item = toy.make_loop(jitter_seed=jitter)
    inputs = Inputs(("left", "front", "speed"), Numbers(speed=True), RIG.views)
    path = Trajectory(TIMES, ("steering", "acceleration"), 2.0, 0.8, 0.4)
    action = Action(trajectory=path)
    policy = TorchPolicy(Waypoints(), NoGoal(), action=action, inputs=inputs)
    car = KinematicSingleTrack(toy.SPEED, wheelbase=2.0)
    sensor = one.sensor.with_rig(RIG)
    return replace(one, sensor=sensor, policy=policy, dynamics=car), item


def test_detached_gradient_of_ten_periods_with_cameras_held(rng):
    loop, item = make_loop()
    rollout = toy.make_rollout(loop, 10)
    evaluation = rollout.run(loop.initial(toy.INITIAL))
    gradient = rollout.gradient(evaluation).textures[0].numpy().astype(float)
    held = replace(rollout, camera_path=CameraPath(evaluation.trajectory.states))
    base = toy.texture_of(item)
    direction = toy.unit(
        toy.unit(gradient) + 0.5 * toy.unit(rng.normal(size=gradient.shape))
    )

    def value(s: float) -> float:
        loop.sensor.set_textures([(base + s * direction).astype(np.float32)])
        return toy.objective(held)

    expected = float((gradient * direction).sum())
    assert central_difference(value, 0.2) == pytest.approx(expected, rel=1e-3)


def test_attached_gradient_of_five_periods_of_the_whole_loop():
    loop, item = make_loop(jitter=None)
    rollout = toy.make_rollout(loop, 5, attached=True)
    gradient = toy.gradient(rollout)
    by_start = np.array(gradient.initial)[:, 0]
    start = loop.dynamics.extend(toy.INITIAL)
    for axis, step in ((0, 1e-2), (1, 1e-2), (2, 2e-3), (3, 1e-2)):

        def value(s: float, axis: int = axis) -> float:
            moved = start.copy()
            moved[0, axis] += s
            return rollout.run(to_state(moved)).value

        scale = np.abs(by_start).max()
        expected = pytest.approx(by_start[axis], rel=5e-3, abs=5e-3 * scale)
        assert central_difference(value, step) == expected
    by_colour = gradient.textures[0].numpy().astype(float)
    base, direction = toy.texture_of(item), toy.unit(by_colour)

    def changed(s: float) -> float:
        loop.sensor.set_textures([(base + s * direction).astype(np.float32)])
        return toy.objective(rollout)

    expected = pytest.approx(float((by_colour * direction).sum()), rel=5e-3)
    assert central_difference(changed, 0.2) == expected
